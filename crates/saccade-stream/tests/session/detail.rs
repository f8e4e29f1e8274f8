//! How finely channels are drawn.

use std::sync::Arc;
use std::time::Duration;

use glam::{DVec3, UVec3};
use saccade_core::volume::Volume;
use saccade_core::voxel_box::VoxelBox;
use saccade_render::View;
use saccade_source::VolumeSource as _;
use saccade_source::memory::ArraySource;
use saccade_stream::{Detail, Session};

use crate::{options, picture, test_gpu, view};

/// Waves along x and y.
fn waves(wavelength: f64) -> Arc<ArraySource> {
    let volume = Volume::new("waves", WAVES, DVec3::new(4.0, 4.0, 4.0)).unwrap();
    Arc::new(ArraySource::new(volume, wave_voxels(wavelength)).unwrap())
}

const WAVES: UVec3 = UVec3::new(160, 150, 90);

fn wave_voxels(wavelength: f64) -> Vec<u8> {
    let wave = |x: u32| (f64::from(x) * std::f64::consts::TAU / wavelength).sin();
    #[expect(clippy::cast_possible_truncation, reason = "20 to 220")]
    #[expect(clippy::cast_sign_loss, reason = "20 to 220")]
    let value = |at: UVec3| (120.0 + 50.0 * wave(at.x) + 50.0 * wave(at.y)) as u8;
    VoxelBox::of_size(WAVES).iter().map(value).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_channel_is_drawn_as_finely_as_its_values_need() {
    let Some(gpu) = test_gpu().await else { return };
    let chosen = Detail::Chosen {
        levels: 0..=u32::MAX,
        coarser: 1,
    };
    for (wavelength, detail, finest) in [
        (40.0, Detail::Full, 0),
        (40.0, Detail::ByContent, 1),
        (4.0, Detail::ByContent, 0),
        (4.0, chosen, 1),
    ] {
        let source = waves(wavelength);
        let view = View {
            lod_bias: -20.0,
            ..view(source.as_ref())
        };
        let mut session = Session::new(&gpu, source, options()).unwrap();
        session.set_detail(0, detail.clone()).unwrap();
        assert!(session.set_detail(1, Detail::Full).is_err());
        let _ = picture(&mut session, &view).await;
        let status = session.frame(&view);
        let case = format!("waves of {wavelength} voxels, {detail:?}");
        assert_eq!(status.fidelity.level, Some(finest), "{case}");
        let by_content = detail == Detail::ByContent;
        let needed = if by_content { finest } else { 0 };
        assert_eq!(session.channels()[0].finest_needed, needed, "{case}");
        // Asked for in full again, it is drawn in full.
        session.set_detail(0, Detail::Full).unwrap();
        let _ = picture(&mut session, &view).await;
        assert_eq!(session.frame(&view).fidelity.level, Some(0), "{case}");
    }
}

/// Nothing arrives any more when somebody chooses: what has arrived tells.
#[tokio::test(flavor = "multi_thread")]
async fn detail_by_content_may_be_chosen_when_all_is_there() {
    let Some(gpu) = test_gpu().await else { return };
    for (wavelength, finest) in [(40.0, 1), (4.0, 0)] {
        let source = waves(wavelength);
        let view = View {
            lod_bias: -20.0,
            ..view(source.as_ref())
        };
        let mut session = Session::new(&gpu, source, options()).unwrap();
        let _ = picture(&mut session, &view).await;
        let case = format!("waves of {wavelength} voxels");
        assert_eq!(session.frame(&view).fidelity.level, Some(0), "{case}");
        assert_eq!(session.channels()[0].finest_needed, 0, "not asked for");
        session.set_detail(0, Detail::ByContent).unwrap();
        assert_eq!(session.channels()[0].finest_needed, finest, "{case}");
        let _ = picture(&mut session, &view).await;
        assert_eq!(session.frame(&view).fidelity.level, Some(finest), "{case}");
    }
}

/// What was acquired later may be finer, or coarser, than what was judged.
#[tokio::test(flavor = "multi_thread")]
async fn detail_by_content_follows_what_changes() {
    let Some(gpu) = test_gpu().await else { return };
    let source = waves(40.0);
    let view = View {
        lod_bias: -20.0,
        ..view(source.as_ref())
    };
    let mut session = Session::new(&gpu, source.clone(), options()).unwrap();
    session.set_detail(0, Detail::ByContent).unwrap();
    for (wavelength, finest) in [(40.0, 1), (4.0, 0), (40.0, 1)] {
        let all = VoxelBox::of_size(source.volume().extent());
        let revision = source.set(all, &wave_voxels(wavelength)).unwrap();
        while session.frame(&view).revision < revision {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        let _ = picture(&mut session, &view).await;
        let level = session.frame(&view).fidelity.level;
        assert_eq!(level, Some(finest), "waves of {wavelength} voxels");
    }
}

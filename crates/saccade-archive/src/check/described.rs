//! What the catalog says of a volume against what its records and its pyramids say.

use saccade_core::volume::{Dtype, Volume};

use super::names::Name;
use super::{Check, CheckError, FindingKind};
use crate::acquisition::AcquisitionInfo;
use crate::catalog::{Tile, VolumeEntry, differences};

/// What helps where the catalog's description of a volume is not right.
const COPY: &str = "put a copy of the catalog in its place, from which `saccade ingest` goes on";

impl Check<'_> {
    /// Holds a volume's description against its acquisition's, where the records are at hand, and against itself.
    pub(super) fn described(&mut self, entry: &VolumeEntry) {
        let volume = &entry.volume;
        // Only those that were read are of this volume.
        let folder = self.folder_of(entry).filter(|_| self.records.is_some());
        let info = folder.and_then(|folder| AcquisitionInfo::read(&folder).ok());
        let said = info.and_then(|info| info.volume().ok());
        let differ = said.map_or_else(Vec::new, |said| differences(volume, &said));
        for (what, has, said) in &differ {
            let reason = format!(
                "the catalog says of the volume that its {what} is {has}, its acquisition {said}: {COPY}"
            );
            self.find(FindingKind::Spoilt, entry, None, reason);
        }
        let made = Volume::new(&volume.name, volume.extent(), volume.voxel_nm);
        let is_made =
            made.is_ok_and(|made| made.levels == volume.levels && made.chunk == volume.chunk);
        // Those of another size are others.
        if !is_made && differ.is_empty() {
            let reason = format!(
                "the levels or the chunks that the catalog says of the volume are none that ingest gives to one of {} voxels of {} nm: \
                 {COPY}",
                volume.extent(),
                volume.voxel_nm
            );
            self.find(FindingKind::Spoilt, entry, None, reason);
        }
    }

    /// Finds a tile whose pyramid was made for another section than its row has it in, where the records are not at hand, which tell.
    pub(super) fn compare_section(&mut self, entry: &VolumeEntry, tile: &Tile) {
        let made_for = Name::of(&tile.pyramid).filter(|name| {
            name.volume == entry.volume.name && name.is_after(&tile.name) && self.records.is_none()
        });
        let Some(section) = made_for
            .map(|name| name.section)
            .filter(|z| *z != tile.section)
        else {
            return;
        };
        let reason = format!(
            "its row has it in section {}, its pyramid was made for section {section}: with --acquisition FOLDER, `saccade check --repair` \
             has it where its record says",
            tile.section
        );
        self.find(FindingKind::Spoilt, entry, Some(tile), reason);
    }

    /// Notes of which type a pyramid's voxels are.
    pub(super) fn compare_type(&mut self, entry: &VolumeEntry, tile: &Tile, dtype: Dtype) {
        if dtype == entry.volume.dtype {
            self.of_its_type += 1;
        } else {
            self.of_other_types.push((tile.clone(), dtype));
        }
    }

    /// Finds pyramids of another type than their volume's; or the volume's type, if none is of it.
    pub(super) async fn of_other_types(&mut self, entry: &VolumeEntry) -> Result<(), CheckError> {
        let others = std::mem::take(&mut self.of_other_types);
        let right = std::mem::take(&mut self.of_its_type);
        let bits = |dtype: Dtype| dtype.bytes() * 8;
        let expected = bits(entry.volume.dtype);
        if right == 0
            && let Some((_, dtype)) = others.first()
        {
            let reason = format!(
                "the catalog says that its voxels have {expected} bits, but none of its {} pyramids are of that, and the first has \
                 {}: {COPY}",
                others.len(),
                bits(*dtype)
            );
            self.find(FindingKind::Spoilt, entry, None, reason);
            return Ok(());
        }
        for (tile, dtype) in others {
            let reason = format!(
                "the pyramid's voxels have {} bits, the volume's {expected}",
                bits(dtype)
            );
            self.mend(FindingKind::Mistaken, entry, &tile, reason)
                .await?;
        }
        Ok(())
    }
}

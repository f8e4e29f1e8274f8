//! Archives that change while they are looked at: nothing of that is damage, and nothing is done to what is whole.

use super::audit::at;
use super::*;

impl Fixture {
    /// Takes in a newer image of a tile, which is said to lie elsewhere.
    pub(super) async fn image_again(&self, tile: &str, to: SectionFromTile) -> NewTile {
        let z = { self.archive.catalog() }
            .tile(VOLUME, tile)
            .await
            .unwrap()
            .unwrap()
            .section;
        self.image_in(tile, z, to).await
    }

    /// The same, in a section.
    pub(super) async fn image_in(&self, tile: &str, z: u32, to: SectionFromTile) -> NewTile {
        let catalog = self.archive.catalog();
        let now = catalog.tile(VOLUME, tile).await.unwrap().unwrap();
        let record = TileRecord {
            tile: tile.to_owned(),
            file: format!("{tile}.tif"),
            section: z,
            size: now.size,
            transform: to,
            channel: None,
        };
        let position = self.append(&Record::Tile(record)).await;
        let pyramid = format!("tiles/v/{:06}/{tile}-{position:x}.tif", z);
        let image = GrayImage {
            width: now.size.x,
            height: now.size.y,
            voxels: vec![9; (now.size.x * now.size.y) as usize].into(),
        };
        let bytes = encode(&image, &Encoding::Lossless).unwrap();
        let bytes = pyramid::named(bytes, &pyramid).unwrap();
        let written = self.archive.storage().write_durable(&pyramid, bytes).await;
        written.unwrap();
        let tile = NewTile {
            name: tile.to_owned(),
            section: z,
            channel: 0,
            size: now.size,
            transform: to,
            pyramid,
            position,
        };
        catalog.commit_tile(VOLUME, &tile).await.unwrap();
        tile
    }

    /// What looks find while `change` is done again and again.
    async fn found_meanwhile(&self, repair: bool, change: impl AsyncFn(u32)) -> Vec<Finding> {
        let changes = async {
            for turn in 0..60 {
                change(turn).await;
            }
        };
        let looks = async {
            let mut found = Vec::new();
            let options = CheckOptions {
                repair,
                acquisition: Some(self.acquisition.path().to_owned()),
                ..CheckOptions::default()
            };
            for _ in 0..30 {
                let report = check(&self.archive, &options, &|_, _| {}).await.unwrap();
                found.extend(report.findings);
            }
            found
        };
        let ((), found) = futures::join!(changes, looks);
        found
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tiles_that_are_imaged_again_are_whole() {
    for repair in [false, true] {
        let fixture = Fixture::new().await;
        let again = async |turn: u32| {
            let tile = ["t2", "t3"][turn as usize % 2];
            fixture.image_again(tile, at(f64::from(turn))).await;
        };
        assert_eq!(fixture.found_meanwhile(repair, again).await, []);
        assert_eq!(fixture.look(false).await.damage(), 0);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tiles_that_go_to_another_section_are_counted_once() {
    for repair in [false, true] {
        let fixture = Fixture::new().await;
        let elsewhere = async |turn: u32| {
            fixture
                .image_in("t2", [0, 1, 2, 5][turn as usize % 4], at(9.0))
                .await;
        };
        assert_eq!(fixture.found_meanwhile(repair, elsewhere).await, []);
        assert_eq!(fixture.look(false).await.damage(), 0);
    }
    // What is not counted is told, whatever else goes on.
    let fixture = Fixture::new().await;
    fixture
        .meddle(&["UPDATE volumes SET tiles = tiles + 1"])
        .await;
    let again = async |turn: u32| {
        fixture.image_again("t2", at(f64::from(turn))).await;
    };
    let found = fixture.found_meanwhile(false, again).await;
    assert_eq!(found.len(), 30, "{found:?}");
    assert!(found.iter().all(|f| f.kind == FindingKind::Miscounted));
}

//! Tile files: written under a temporary name, visible only when whole.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use saccade_archive::image::GrayImage;
use tiff::encoder::TiffEncoder;
use tiff::encoder::colortype::Gray8;

/// The name under which a file is written before it is whole.
pub(crate) fn part_of(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".part");
    PathBuf::from(name)
}

/// Writes an uncompressed 8-bit TIFF under the temporary name of `path`, and returns that name.
pub(crate) fn write_part(path: &Path, image: &GrayImage) -> io::Result<PathBuf> {
    let part = part_of(path);
    let mut file = BufWriter::with_capacity(1 << 20, File::create(&part)?);
    let encoded = TiffEncoder::new(&mut file)
        .and_then(|mut tiff| tiff.write_image::<Gray8>(image.width, image.height, &image.voxels));
    encoded.map_err(|error| match error {
        tiff::TiffError::IoError(error) => error,
        other => io::Error::other(other),
    })?;
    file.flush()?;
    Ok(part)
}

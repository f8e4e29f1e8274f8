//! Files of several pages.

use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

use tiff::decoder::Decoder;

use super::super::sniff::{self, HEAD, Kind};
use super::super::{Image, ImageError, Wanted};
use super::{check_page, decode_page, open, sort, unsupported};
use crate::storage::open_regular;

/// The pages of a TIFF file, each an image like that of a file of its own.
///
/// Where each begins is remembered, so that the last is reached as soon as the first.
pub struct Pages {
    decoder: Decoder<BufReader<File>>,
    /// Length of the file when it was opened \[bytes\].
    len: u64,
    count: u32,
    path: PathBuf,
}

impl std::fmt::Debug for Pages {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Pages({} of {})", self.count, self.path.display())
    }
}

impl Pages {
    /// Opens a file and counts its pages, of which nothing else is looked at.
    ///
    /// # Errors
    ///
    /// [`ImageError`]: also for a file that is no TIFF.
    pub fn open(path: &Path) -> Result<Self, ImageError> {
        let failed = |source| ImageError::Read {
            source,
            path: path.to_owned(),
        };
        let mut file = open_regular(path).map_err(failed)?;
        let len = file.metadata().map_err(failed)?.len();
        let mut head = Vec::new();
        let mut start = file.by_ref().take(HEAD);
        start.read_to_end(&mut head).map_err(failed)?;
        if sniff::kind(&head)? != Kind::Tiff {
            return Err(unsupported("pages of a file that is no TIFF"));
        }
        file.rewind().map_err(failed)?;
        let mut decoder = open(BufReader::new(file), len)?;
        let mut count: u32 = 1;
        // A file whose pages lead back to one another is refused there.
        while decoder.more_images() {
            decoder.next_image().map_err(sort)?;
            count += 1;
        }
        Ok(Self {
            decoder,
            len,
            count,
            path: path.to_owned(),
        })
    }

    /// How many there are; at least 1.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// Width and height of a page, from 0 \[pixels\], once all was looked at that can be without decoding it.
    ///
    /// # Errors
    ///
    /// [`ImageError`].
    pub fn check(&mut self, page: u32, wanted: Wanted) -> Result<[u32; 2], ImageError> {
        self.seek(page)?;
        let page = check_page(&mut self.decoder, self.len, wanted)?;
        Ok([page.width, page.height])
    }

    /// Decodes a page, from 0.
    ///
    /// # Errors
    ///
    /// [`ImageError`].
    pub fn decode(&mut self, page: u32, wanted: Wanted) -> Result<Image, ImageError> {
        self.seek(page)?;
        decode_page(&mut self.decoder, self.len, wanted)
    }

    fn seek(&mut self, page: u32) -> Result<(), ImageError> {
        self.decoder.seek_to_image(page as usize).map_err(sort)
    }
}

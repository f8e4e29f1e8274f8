use std::io::Cursor;

use bytes::Bytes;
use image::codecs::jpeg::JpegDecoder;

use super::{Damage, Shape, damage, picture};

/// Of colours that are stored more coarsely than shades, a value may be some steps from what other programs make of it: how they
/// are filled in between is left to the decoder.
pub(super) fn decode(bytes: &[u8], shape: Shape) -> Result<Bytes, Damage> {
    picture(JpegDecoder::new(Cursor::new(bytes)).map_err(damage)?, shape)
}

use bytes::Bytes;

use super::{Damage, read};

pub(super) fn decode(bytes: &[u8], most: usize) -> Result<Bytes, Damage> {
    let decoder = ruzstd::decoding::StreamingDecoder::new(bytes);
    let decoder = decoder.map_err(|error| format!("it does not decompress: {error}"))?;
    read(decoder, most)
}

pub(super) fn decode_into(bytes: &[u8], decoded: &mut [u8]) -> Result<(), Damage> {
    let whole = decode(bytes, decoded.len())?;
    if whole.len() != decoded.len() {
        return Err(format!(
            "{} bytes come out instead of {}",
            whole.len(),
            decoded.len()
        ));
    }
    decoded.copy_from_slice(&whole);
    Ok(())
}

use std::cell::RefCell;

use bytes::Bytes;
use zstd::bulk::Decompressor;

use super::{Damage, read, too_much};

thread_local! {
    static DECOMPRESSOR: RefCell<Option<Decompressor<'static>>> = const { RefCell::new(None) };
}

pub(super) fn decode(bytes: &[u8], most: usize) -> Result<Bytes, Damage> {
    // Room is made for what the first frame says; where it says nothing, or there are others, for what comes.
    let told = zstd::zstd_safe::get_frame_content_size(bytes)
        .ok()
        .flatten();
    let frame = zstd::zstd_safe::find_frame_compressed_size(bytes);
    match told {
        Some(told) if told > most as u64 => Err(too_much(most)),
        Some(told) if frame == Ok(bytes.len()) => {
            let mut decoded = Vec::with_capacity(usize::try_from(told).unwrap_or(most));
            decode_to(bytes, &mut decoded)?;
            Ok(decoded.into())
        }
        _ => {
            let decoder = zstd::stream::Decoder::with_buffer(bytes);
            read(
                decoder.map_err(|error| format!("it does not decompress: {error}"))?,
                most,
            )
        }
    }
}

/// Into a vector's capacity.
fn decode_to(bytes: &[u8], decoded: &mut Vec<u8>) -> Result<(), Damage> {
    DECOMPRESSOR.with_borrow_mut(|kept| {
        let failed = |error| format!("it does not decompress: {error}");
        let decompressor = match kept {
            Some(decompressor) => decompressor,
            None => kept.insert(Decompressor::new().map_err(failed)?),
        };
        decompressor
            .decompress_to_buffer(bytes, decoded)
            .map_err(failed)?;
        Ok(())
    })
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

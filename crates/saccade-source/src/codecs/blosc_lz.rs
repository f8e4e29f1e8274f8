//! BloscLZ: literals, and copies of what came before, in the manner of FastLZ.

use super::Damage;

/// Copies that reach farther have two more bytes of distance.
const NEAR: usize = 8191;

/// Decompresses `from`; exactly `to` comes out.
pub(super) fn decode_into(from: &[u8], to: &mut [u8]) -> Result<(), Damage> {
    let short = || "it ends too early".to_owned();
    let mut bytes = from.iter().copied();
    let mut next = || bytes.next().map(usize::from).ok_or_else(short);
    let mut at = 0_usize;
    // The first instruction is always a literal's.
    let mut instruction = next()? & 31;
    loop {
        if instruction >= 32 {
            let mut length = (instruction >> 5) - 1;
            let high = (instruction & 31) << 8;
            if length == 6 {
                loop {
                    let more = next()?;
                    length += more;
                    if more < 255 || length > to.len() {
                        break;
                    }
                }
            }
            let low = next()?;
            let distance = if low == 255 && high == 31 << 8 {
                NEAR + (next()? << 8) + next()?
            } else {
                high + low
            };
            length += 3;
            let begin = at
                .checked_sub(distance + 1)
                .ok_or("it copies from before its beginning")?;
            if length > to.len() - at {
                return Err("more comes out than should".to_owned());
            }
            if distance + 1 >= length {
                to.copy_within(begin..begin + length, at);
            } else {
                // What it copies, it has just written.
                for n in 0..length {
                    to[at + n] = to[begin + n];
                }
            }
            at += length;
        } else {
            for _ in 0..=instruction {
                let literal = next()?;
                let to = to.get_mut(at).ok_or("more comes out than should")?;
                *to = u8::try_from(literal).expect("it was a byte");
                at += 1;
            }
        }
        match next() {
            Ok(more) => instruction = more,
            Err(_) if at == to.len() => return Ok(()),
            Err(_) => return Err(format!("{at} bytes come out instead of {}", to.len())),
        }
    }
}

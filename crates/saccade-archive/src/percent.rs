//! Percent-encoding, as URLs and object stores write names.

/// Undoes it; `None` for what cannot have been encoded.
pub(crate) fn decoded(text: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.bytes();
    while let Some(byte) = rest.next() {
        bytes.push(match byte {
            b'%' => digit(rest.next()?)? << 4 | digit(rest.next()?)?,
            byte => byte,
        });
    }
    String::from_utf8(bytes).ok()
}

fn digit(byte: u8) -> Option<u8> {
    char::from(byte).to_digit(16)?.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_decoded() {
        assert_eq!(decoded("a/%7Eb%25c").as_deref(), Some("a/~b%c"));
        assert_eq!(decoded("a%C3%84%c3%a4").as_deref(), Some("aÄä"));
        for bad in ["%", "a%4", "%zz", "%ff", "%+1", "%é"] {
            assert_eq!(decoded(bad), None, "{bad}");
        }
    }
}

//! Server-sent events, parsed as they come in, in pieces of any size.

/// Longest line or event that is kept \[bytes\]; longer ones are cut.
const LONGEST: usize = 1 << 20;

/// One event.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Event {
    /// Its type; empty for the default one.
    pub(super) kind: String,
    /// Its lines of data.
    pub(super) data: String,
    /// The last id that was given, by this event or an earlier one.
    pub(super) id: Option<String>,
}

/// Follows the rules of the HTML standard, §9.2.6.
#[derive(Default)]
pub(super) struct EventParser {
    line: Vec<u8>,
    /// The last byte was a carriage return: a line feed now belongs to it.
    after_return: bool,
    /// Something other than a byte order mark was seen.
    begun: bool,
    event: Event,
    has_data: bool,
    retry_ms: Option<u64>,
}

impl EventParser {
    /// How long to wait before connecting again \[ms\], if the server said so.
    pub(super) fn retry_ms(&self) -> Option<u64> {
        self.retry_ms
    }

    /// Takes in more bytes; returns the events they complete.
    pub(super) fn feed(&mut self, bytes: &[u8]) -> Vec<Event> {
        let mut events = Vec::new();
        for byte in bytes {
            let ends_return = std::mem::replace(&mut self.after_return, *byte == b'\r');
            match byte {
                b'\n' if ends_return => {}
                b'\n' | b'\r' => events.extend(self.end_line()),
                _ if self.line.len() < LONGEST => self.line.push(*byte),
                _ => {}
            }
        }
        events
    }

    fn end_line(&mut self) -> Option<Event> {
        let bytes = std::mem::take(&mut self.line);
        let text = String::from_utf8_lossy(&bytes);
        let mut line = text.as_ref();
        if !std::mem::replace(&mut self.begun, true) {
            line = line.strip_prefix('\u{feff}').unwrap_or(line);
        }
        if line.is_empty() {
            return self.end_event();
        }
        // A comment has an empty field name.
        let (field, value) = line.split_once(':').unwrap_or((line, ""));
        let value = value.strip_prefix(' ').unwrap_or(value);
        match field {
            "event" => self.event.kind = value.to_owned(),
            "data" => {
                if self.has_data && self.event.data.len() < LONGEST {
                    self.event.data.push('\n');
                }
                self.has_data = true;
                let room = self.event.data.len() + value.len() <= LONGEST;
                self.event.data.push_str(if room { value } else { "" });
            }
            "id" if !value.contains('\0') => self.event.id = Some(value.to_owned()),
            "retry" => self.retry_ms = value.parse().ok().or(self.retry_ms),
            _ => {}
        }
        None
    }

    fn end_event(&mut self) -> Option<Event> {
        let next = Event {
            id: self.event.id.clone(),
            ..Event::default()
        };
        let event = std::mem::replace(&mut self.event, next);
        std::mem::take(&mut self.has_data).then_some(event)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const STREAM: &str = "\u{feff}: hello\n\nevent: change\nid: 7\ndata: {\"a\":1}\n\n\
        data:x\r\ndata: y\r\n\r\nretry: 1500\rid\rdata\r\r\
        unknown: field\nid: no\0no\n: comment\ndata:  ü\n\nevent: forgotten\n\nevent: cut\ndata: o";

    fn events() -> [Event; 4] {
        let event = |kind: &str, data: &str, id: &str| Event {
            kind: kind.into(),
            data: data.into(),
            id: Some(id.into()),
        };
        [
            event("change", "{\"a\":1}", "7"),
            event("", "x\ny", "7"),
            event("", "", ""),
            event("", " ü", ""),
        ]
    }

    #[test]
    fn follows_the_standard() {
        let mut parser = EventParser::default();
        assert_eq!(parser.feed(STREAM.as_bytes()), events());
        assert_eq!(parser.retry_ms(), Some(1500));
    }

    #[test]
    fn pieces_do_not_matter() {
        let bytes = STREAM.as_bytes();
        for size in 1..bytes.len() {
            let mut parser = EventParser::default();
            let seen: Vec<_> = bytes.chunks(size).flat_map(|p| parser.feed(p)).collect();
            assert_eq!(seen, events(), "in pieces of {size}");
        }
        for at in 0..bytes.len() {
            let mut parser = EventParser::default();
            let mut seen = parser.feed(&bytes[..at]);
            seen.extend(parser.feed(&bytes[at..]));
            assert_eq!(seen, events(), "cut at {at}");
        }
    }

    #[test]
    fn endless_lines_take_bounded_memory() {
        let mut parser = EventParser::default();
        for _ in 0..5 {
            assert!(parser.feed(&vec![b'a'; LONGEST]).is_empty());
        }
        assert!(parser.line.len() <= LONGEST);
        let mut parser = EventParser::default();
        for _ in 0..3 {
            assert!(parser.feed(&b"data\n".repeat(LONGEST / 2)).is_empty());
        }
        assert!(parser.event.data.len() <= LONGEST);
    }

    /// What streams are made of, right and wrong.
    const PIECES: [&[u8]; 14] = [
        b"data:",
        b"event: change",
        b"id:7",
        b"id",
        b"retry:99999999999999999999",
        b"\n",
        b"\r",
        b"\r\n",
        b"\n\n",
        b": comment",
        b"{\"revision\":1}",
        b"\xef\xbb\xbf",
        b"\xff\xfe\0",
        b" ",
    ];

    proptest! {
        #[test]
        fn foreign_bytes_are_survived_however_they_are_cut(
            pieces in prop::collection::vec(prop_oneof![
                (0..PIECES.len()).prop_map(|n| PIECES[n].to_vec()),
                prop::collection::vec(any::<u8>(), 0..9),
            ], 0..60),
            size in 1..17_usize,
        ) {
            let bytes = pieces.concat();
            let mut whole = EventParser::default();
            let mut cut = EventParser::default();
            let seen: Vec<_> = bytes.chunks(size).flat_map(|piece| cut.feed(piece)).collect();
            prop_assert_eq!(whole.feed(&bytes), seen);
            prop_assert_eq!(whole.retry_ms(), cut.retry_ms());
        }
    }
}

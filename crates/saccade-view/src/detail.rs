//! How finely channels are drawn: as people choose it, and as addresses name it.

use saccade_stream::Detail;

use crate::shown::{ShownError, each_channel};

/// How finely channels are drawn: `full`, `content`, levels coarser, as in `1`, or the levels that are drawn, as in
/// `1-4`, `1-` or `1-4+1`, which is one coarser than the view asks for; for all of them, or each as in
/// `0:full,2:1-4+1`.
///
/// # Errors
///
/// [`ShownError`] on anything else.
pub fn details_from_text(text: &str) -> Result<Vec<(Option<u32>, Detail)>, ShownError> {
    each_channel(text, detail_from_text).map_or_else(
        || {
            let wanted = "full, content, a number of levels coarser, or the levels from the finest to the \
                          coarsest, as in 1-4 or 1-4+1; for all channels or each once, as in 0:full,2:1-4+1";
            ShownError::of(text, "detail of channels", wanted)
        },
        Ok,
    )
}

fn detail_from_text(text: &str) -> Option<Detail> {
    match text {
        "full" => return Some(Detail::Full),
        "content" => return Some(Detail::ByContent),
        _ => {}
    }
    if let Ok(coarser) = text.parse() {
        let levels = 0..=u32::MAX;
        return Some(Detail::Chosen { levels, coarser });
    }
    let (levels, coarser) = match text.split_once('+') {
        Some((levels, coarser)) => (levels, number(coarser)?),
        None => (text, 0),
    };
    let (finest, coarsest) = levels.split_once('-')?;
    let coarsest = match coarsest {
        "" => u32::MAX,
        level => number(level)?,
    };
    let levels = number(finest)?..=coarsest;
    (!levels.is_empty()).then_some(Detail::Chosen { levels, coarser })
}

/// Digits alone.
fn number(text: &str) -> Option<u32> {
    let digits = text.bytes().all(|byte| byte.is_ascii_digit());
    digits.then(|| text.parse().ok()).flatten()
}

/// A channel's detail as [`details_from_text`] reads it.
pub(crate) fn text_of(detail: &Detail) -> String {
    let (levels, coarser) = match detail {
        Detail::Full => return "full".to_owned(),
        Detail::ByContent => return "content".to_owned(),
        Detail::Chosen { levels, coarser } => (levels, coarser),
    };
    let levels = match (levels.start(), levels.end()) {
        (0, &u32::MAX) => return coarser.to_string(),
        (finest, &u32::MAX) => format!("{finest}-"),
        (finest, coarsest) => format!("{finest}-{coarsest}"),
    };
    match coarser {
        0 => levels,
        coarser => format!("{levels}+{coarser}"),
    }
}

/// The finest and the coarsest level that are drawn, of a volume whose coarsest is `last`.
pub(crate) fn bounds(detail: &Detail, last: u32) -> [u32; 2] {
    match detail {
        Detail::Full | Detail::ByContent => [0, last],
        Detail::Chosen { levels, .. } => [*levels.start(), *levels.end()].map(|l| l.min(last)),
    }
}

/// How many levels coarser than others it is drawn.
pub(crate) fn coarser(detail: &Detail) -> u32 {
    match detail {
        Detail::Full | Detail::ByContent => 0,
        Detail::Chosen { coarser, .. } => *coarser,
    }
}

/// These levels of a volume whose coarsest is `last`, and so many coarser than the view asks for. A bound that is
/// moved past the other takes it along.
pub(crate) fn chosen(moved: [u32; 2], before: [u32; 2], last: u32, coarser: u32) -> Detail {
    let [mut finest, mut coarsest] = moved.map(|level| level.min(last));
    if finest > coarsest {
        match coarsest == before[1] {
            true => coarsest = finest,
            false => finest = coarsest,
        }
    }
    // Whatever becomes the coarsest level of a volume that grows.
    let coarsest = if coarsest == last { u32::MAX } else { coarsest };
    match (finest, coarsest, coarser) {
        (0, u32::MAX, 0) => Detail::Full,
        _ => Detail::Chosen {
            levels: finest..=coarsest,
            coarser,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn levels(finest: u32, coarsest: u32, coarser: u32) -> Detail {
        Detail::Chosen {
            levels: finest..=coarsest,
            coarser,
        }
    }

    #[test]
    fn text_names_how_fine_channels_are() {
        for (text, want) in [
            ("full", vec![(None, Detail::Full)]),
            ("2", vec![(None, levels(0, u32::MAX, 2))]),
            ("1-4", vec![(None, levels(1, 4, 0))]),
            ("3-3", vec![(None, levels(3, 3, 0))]),
            ("1-", vec![(None, levels(1, u32::MAX, 0))]),
            ("2:1-4+1", vec![(Some(2), levels(1, 4, 1))]),
            ("0:2-+3", vec![(Some(0), levels(2, u32::MAX, 3))]),
            (
                "0:full, 3:2,content",
                vec![
                    (Some(0), Detail::Full),
                    (Some(3), levels(0, u32::MAX, 2)),
                    (None, Detail::ByContent),
                ],
            ),
        ] {
            assert_eq!(details_from_text(text), Ok(want), "{text:?}");
        }
        for bad in [
            "",
            "fine",
            "a:full",
            "0:",
            "0:-1",
            "0:1:2",
            ",",
            "4-1",
            "1-4+",
            "1-4++1",
            "1-4+-1",
            "1-4-5",
            "-",
            "-4",
            "+1-4",
            "1-+4+1",
            "1 - 4",
            "full+1",
            "1-4294967296",
            "0:full,0:2",
            "full,2",
        ] {
            let error = details_from_text(bad).map_err(|error| error.to_string());
            assert!(
                error.clone().is_err_and(|e| e.contains("1-4+1")),
                "{bad:?}: {error:?}"
            );
        }
    }

    #[test]
    fn what_is_printed_is_read() {
        for detail in [
            Detail::Full,
            Detail::ByContent,
            levels(0, u32::MAX, 0),
            levels(0, u32::MAX, 3),
            levels(0, 4, 0),
            levels(1, u32::MAX, 0),
            levels(1, u32::MAX, 2),
            levels(2, 2, 0),
            levels(1, 4, 1),
        ] {
            let text = format!("7:{}", text_of(&detail));
            assert_eq!(
                details_from_text(&text),
                Ok(vec![(Some(7), detail)]),
                "{text}"
            );
        }
    }

    #[test]
    fn bounds_are_moved_within_the_volume() {
        let detail = levels(1, 3, 2);
        assert_eq!((bounds(&detail, 5), coarser(&detail)), ([1, 3], 2));
        assert_eq!(bounds(&levels(7, 9, 0), 5), [5, 5], "there are no others");
        assert_eq!(bounds(&Detail::Full, 5), [0, 5]);
        assert_eq!(chosen([2, 3], [1, 3], 5, 2), levels(2, 3, 2));
        assert_eq!(chosen([4, 3], [1, 3], 5, 0), levels(4, 4, 0), "taken along");
        assert_eq!(chosen([2, 1], [2, 3], 5, 0), levels(1, 1, 0), "taken along");
        assert_eq!(chosen([0, 5], [1, 5], 5, 1), levels(0, u32::MAX, 1));
        assert_eq!(chosen([0, 5], [1, 5], 5, 0), Detail::Full);
        assert_eq!(chosen([3, 5], [0, 5], 5, 0), levels(3, u32::MAX, 0));
    }
}

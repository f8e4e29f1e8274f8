//! Transfer functions, as the command line and addresses name them.

use saccade_core::transfer::{OpacityPoint, TransferFunction};

/// Text that is no transfer function with which anything could be seen.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TransferError {
    /// Another text.
    #[error("this is no transfer function as JSON")]
    Json {
        /// What is wrong with it.
        #[from]
        source: serde_json::Error,
    },
    /// A window without width.
    #[error("the two ends of the window have to differ, not {low} and {high}")]
    Window {
        /// Value of the first colour.
        low: f32,
        /// Value of the last.
        high: f32,
    },
    /// An opacity of no thickness.
    #[error("opacity_length_nm has to be above 0, not {length}")]
    Length {
        /// As given \[nm\].
        length: f64,
    },
    /// A point of the opacity elsewhere.
    #[error("values and opacities go from 0 to 1")]
    Range,
    /// Points of the opacity that are mixed up.
    #[error("the points of the opacity have to be in the order of their values")]
    Order,
}

/// Whose transfer function a text is, and what remains of it: `2:auto` is channel 2's, `auto` that of the first channel
/// that is seen.
pub fn channel_of_text(text: &str) -> (Option<u32>, &str) {
    let channel = text.split_once(':').and_then(|(channel, rest)| {
        let channel = channel.trim().parse().ok()?;
        Some((Some(channel), rest.trim()))
    });
    channel.unwrap_or((None, text.trim()))
}

/// Colours and opacities from JSON.
///
/// # Errors
///
/// [`TransferError`] on anything else, and where nothing could be seen with them.
pub fn transfer_from_text(json: &str) -> Result<TransferFunction, TransferError> {
    let transfer: TransferFunction = serde_json::from_str(json)?;
    let [low, high] = transfer.window;
    if !(low.is_finite() && high.is_finite() && low != high) {
        return Err(TransferError::Window { low, high });
    }
    let length = transfer.opacity_length_nm;
    if !(length.is_finite() && length > 0.0) {
        return Err(TransferError::Length { length });
    }
    let within = |value: f32| (0.0..=1.0).contains(&value);
    let sensible = |point: &OpacityPoint| within(point.value) && within(point.opacity);
    if !transfer.opacity.iter().all(sensible) {
        return Err(TransferError::Range);
    }
    if !transfer.opacity.is_sorted_by(|a, b| a.value <= b.value) {
        return Err(TransferError::Order);
    }
    Ok(transfer)
}

#[cfg(test)]
mod tests {
    use saccade_core::transfer::{ColorMap, Histogram};

    use super::*;

    #[test]
    fn text_names_channels() {
        for (text, want) in [
            ("auto", (None, "auto")),
            ("2:auto", (Some(2), "auto")),
            (" 10 : file.json ", (Some(10), "file.json")),
            ("file.json", (None, "file.json")),
            ("C:/file.json", (None, "C:/file.json")),
            ("-1:auto", (None, "-1:auto")),
            (r#"{"window": [0, 1]}"#, (None, r#"{"window": [0, 1]}"#)),
            (r#"0:{"a": 1}"#, (Some(0), r#"{"a": 1}"#)),
        ] {
            assert_eq!(channel_of_text(text), want, "{text:?}");
        }
    }

    #[test]
    fn what_is_printed_is_read() {
        let transfer = TransferFunction {
            color_map: ColorMap::Color([1, 2, 3]),
            ..Histogram::default().transfer_function(glam::DVec3::splat(100.0))
        };
        let json = serde_json::to_string(&transfer).unwrap();
        assert_eq!(transfer_from_text(&json).unwrap(), transfer);
    }

    #[test]
    fn what_shows_nothing_is_refused() {
        let with = |window: &str, length: &str, opacity: &str| {
            let json = format!(
                r#"{{"polarity": "dark", "color_map": "bone", "window": {window}, "opacity": {opacity},
                    "opacity_length_nm": {length}}}"#
            );
            transfer_from_text(&json)
        };
        let points = r#"[{"value": 0.1, "opacity": 1}, {"value": 0.9, "opacity": 0}]"#;
        let mixed = r#"[{"value": 0.9, "opacity": 1}, {"value": 0.1, "opacity": 0}]"#;
        let beyond = r#"[{"value": 0.1, "opacity": 1.5}]"#;
        assert!(with("[0, 1]", "9", points).is_ok());
        let misspelt = with(r#"[0, 1], "opacty": 3"#, "9", points);
        assert!(
            matches!(misspelt, Err(TransferError::Json { .. })),
            "{misspelt:?}"
        );
        let misspelt = with(
            "[0, 1]",
            "9",
            r#"[{"value": 0.1, "opacity": 1, "vlaue": 2}]"#,
        );
        assert!(
            matches!(misspelt, Err(TransferError::Json { .. })),
            "{misspelt:?}"
        );
        assert!(matches!(
            with("[1, 1]", "9", points),
            Err(TransferError::Window { .. })
        ));
        assert!(matches!(
            with("[0, 1]", "0", points),
            Err(TransferError::Length { .. })
        ));
        assert!(matches!(
            with("[0, 1]", "9", beyond),
            Err(TransferError::Range)
        ));
        assert!(matches!(
            with("[0, 1]", "9", mixed),
            Err(TransferError::Order)
        ));
        assert!(matches!(
            transfer_from_text("{}"),
            Err(TransferError::Json { .. })
        ));
    }
}

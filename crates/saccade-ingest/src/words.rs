//! Errors in words.

use std::error::Error;

/// An error and what is behind it, in one line. Some libraries repeat their cause in their own message: it is said once.
pub(crate) fn with_causes(error: &(dyn Error + 'static)) -> String {
    let mut said: Vec<String> = Vec::new();
    let mut next = Some(error);
    while let Some(error) = next {
        let cause = error.to_string();
        if !said.iter().any(|before| before.contains(&cause)) {
            said.push(cause);
        }
        next = error.source();
    }
    said.join(": ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("{text}")]
    struct Failed {
        text: &'static str,
        source: Option<Box<Self>>,
    }

    #[test]
    fn a_cause_that_was_said_is_not_said_again() {
        let texts = [
            "timed out",
            "not sent",
            "HTTP: not sent",
            "cannot put x: HTTP: not sent",
            "store",
        ];
        let error = texts.into_iter().fold(None, |source, text| {
            let source = source.map(Box::new);
            Some(Failed { text, source })
        });
        let said = with_causes(&error.unwrap());
        assert_eq!(said, "store: cannot put x: HTTP: not sent: timed out");
    }
}

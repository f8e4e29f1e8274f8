use super::StorageError;

/// Longest part of a name between slashes \[bytes\]; file systems allow 255.
const MAX_PART: usize = 240;
/// Longest name \[bytes\]; object stores allow 1024.
const MAX_NAME: usize = 1024;

/// Checks that `name` can name an object everywhere: relative parts joined by `/`, no part empty,
/// none beginning with a dot (so no `..`, and unfinished writes have a place of their own), no
/// backslash, colon or control character.
///
/// # Errors
///
/// [`StorageError::Name`].
pub fn check_name(name: &str) -> Result<(), StorageError> {
    let reason = if name.is_empty() {
        "it is empty"
    } else if name.len() > MAX_NAME {
        "it is longer than 1024 bytes"
    } else if name.split('/').any(str::is_empty) {
        "it has an empty part; names are relative, with single slashes"
    } else if name.split('/').any(|part| part.starts_with('.')) {
        "a part of it begins with a dot"
    } else if name.split('/').any(|part| part.len() > MAX_PART) {
        "a part of it is longer than 240 bytes"
    } else if name
        .chars()
        .any(|c| c == '\\' || c == ':' || c.is_control())
    {
        "it has a backslash, a colon or a control character"
    } else {
        return Ok(());
    };
    Err(StorageError::Name {
        name: name.to_owned(),
        reason,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_below_the_root() {
        for good in [
            "a",
            "tiles/a b.tif",
            "tiles/Ä/x..y.tif",
            &"n".repeat(MAX_PART),
        ] {
            assert!(check_name(good).is_ok(), "{good:?}");
        }
        let long = "n".repeat(MAX_PART + 1);
        let deep = "n/".repeat(600) + "n";
        for bad in [
            "",
            "/",
            "/a",
            "a/",
            "a//b",
            "..",
            "a/../b",
            "./a",
            ".incoming/a",
            "a\\b",
            "C:a",
            "a\0b",
            "a\nb",
            &long,
            &deep,
        ] {
            assert!(
                matches!(check_name(bad), Err(StorageError::Name { .. })),
                "{bad:?}"
            );
        }
    }
}

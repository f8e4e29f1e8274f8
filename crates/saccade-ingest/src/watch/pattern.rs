//! What file names mean.

use std::collections::HashSet;
use std::fmt;
use std::str::FromStr;

/// A pattern of paths below a folder, such as `s{section}/r{row}_c{column}_{channel}.tif`.
///
/// `{section}`, `{row}` and `{column}` are numbers, `{channel}` a name; `{}` is anything that does not
/// matter. Numbers are read as far as they go; names and anything end where what follows them begins.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern {
    /// Of each folder, and last of the file.
    parts: Vec<Vec<Piece>>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Piece {
    Text(String),
    Number(Field),
    Channel,
    Anything,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Field {
    Section,
    Row,
    Column,
}

/// A pattern that cannot be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the pattern {pattern:?} {reason}; write it like {example}")]
pub struct PatternError {
    /// As given.
    pub pattern: String,
    /// What is wrong with it.
    pub reason: String,
    /// One that can be.
    pub example: &'static str,
}

/// What a name says.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct Place {
    /// Section, as it is numbered there.
    pub section: u32,
    /// Row.
    pub row: u32,
    /// Column.
    pub column: u32,
    /// Channel, if names say one.
    pub channel: Option<String>,
}

impl Place {
    /// A name for the tile, the same for the same place.
    pub fn name(&self) -> String {
        let Self {
            section,
            row,
            column,
            channel,
        } = self;
        let channel = channel
            .as_ref()
            .map_or_else(String::new, |c| format!("_{c}"));
        format!("s{section}_r{row}_c{column}{channel}")
    }
}

impl Pattern {
    /// One of names that say the channel alone, such as `{}_{channel}.tif`: numbers of sections, rows and columns must be
    /// there where it has such, and do not matter.
    ///
    /// # Errors
    ///
    /// [`PatternError`].
    pub fn of_channels(pattern: &str) -> Result<Self, PatternError> {
        let example = "{}_{channel}.tif or {channel}/{}";
        let (parts, named) = parsed(pattern, example)?;
        if !named.contains(&"channel") {
            return Err(PatternError {
                pattern: pattern.to_owned(),
                reason: "does not say where the name of the {channel} is".to_owned(),
                example,
            });
        }
        Ok(Self { parts })
    }

    /// The channel that a path says, by its last parts; or why it fits no part of this.
    pub(crate) fn channel(&self, path: &str) -> Result<String, String> {
        let names: Vec<&str> = { path.split(['/', '\\']) }
            .filter(|name| !name.is_empty())
            .collect();
        let last = names.len().saturating_sub(self.parts.len());
        let names = &names[last..];
        let mut place = Place::default();
        let fits = names.len() == self.parts.len() && { names.iter().zip(&self.parts) }
            .all(|(name, part)| fit(part, name, &mut place).is_ok());
        let channel = place.channel.filter(|_| fits);
        channel.ok_or_else(|| self.mismatch(&names.join("/"), false).unwrap_or_default())
    }

    /// Folders above a file.
    pub fn depth(&self) -> usize {
        self.parts.len() - 1
    }

    /// Whether a folder, `depth` folders below the one watched, may hold files of this pattern: what is
    /// known by then, `None` if not.
    pub fn folder(&self, depth: usize, name: &str, known: &Place) -> Option<Place> {
        let mut place = known.clone();
        let part = self.parts.get(depth).filter(|_| depth < self.depth())?;
        fit(part, name, &mut place).is_ok().then_some(place)
    }

    /// Whether a name can hardly be but that of such a folder: it is as the pattern spells it, or has its numbers.
    pub(crate) fn is_a_folder(&self, depth: usize, name: &str) -> bool {
        let Some(part) = self.parts.get(depth).filter(|_| depth < self.depth()) else {
            return false;
        };
        let is_certain = part.iter().all(|piece| matches!(piece, Piece::Text(_)))
            || part.iter().any(|piece| matches!(piece, Piece::Number(_)));
        is_certain && fit(part, name, &mut Place::default()).is_ok()
    }

    /// What a file's name says, with what its folders said.
    pub fn file(&self, name: &str, known: &Place) -> Option<Place> {
        let mut place = known.clone();
        fit(self.parts.last()?, name, &mut place)
            .is_ok()
            .then_some(place)
    }

    /// Why a path below the watched folder fits no part of this; `None` if it fits.
    pub fn mismatch(&self, path: &str, folder: bool) -> Option<String> {
        let names: Vec<&str> = path.split('/').collect();
        for (name, pieces) in names.iter().zip(&self.parts) {
            let Err(stuck) = fit(pieces, name, &mut Place::default()) else {
                continue;
            };
            let wanted = match stuck.wanted {
                None => "nothing more".to_owned(),
                Some(Piece::Text(text)) => format!("{text:?}"),
                Some(Piece::Number(_)) => format!("a number for {}", shown(stuck.wanted)),
                Some(_) => format!("a name for {}", shown(stuck.wanted)),
            };
            let (at, rest) = name.split_at(name.len() - stuck.rest.len());
            let place = match (at, rest) {
                ("", _) => format!("{name:?} begins otherwise"),
                (_, "") => format!("{name:?} ends"),
                _ => format!("after {at:?} comes {rest:?}"),
            };
            return Some(format!("{place} where {wanted} should be"));
        }
        let (deep, want) = (names.len() - 1, self.depth());
        if folder {
            (deep >= want).then(|| "it is a folder where the pattern has files".to_owned())
        } else {
            (deep != want)
                .then(|| format!("it lies {deep} folders deep, the pattern's files {want}"))
        }
    }
}

fn shown(piece: Option<&Piece>) -> &'static str {
    match piece {
        Some(Piece::Number(Field::Section)) => "{section}",
        Some(Piece::Number(Field::Row)) => "{row}",
        Some(Piece::Number(Field::Column)) => "{column}",
        Some(Piece::Channel) => "{channel}",
        Some(Piece::Anything) => "{}",
        Some(Piece::Text(_)) | None => "",
    }
}

/// How far a name fits.
struct Stuck<'a> {
    /// What is left of the name.
    rest: &'a str,
    /// What should come there; `None`: the end.
    wanted: Option<&'a Piece>,
}

/// What a name says goes to `place`; if it does not fit, how far it does.
fn fit<'a>(pieces: &'a [Piece], name: &'a str, place: &mut Place) -> Result<(), Stuck<'a>> {
    fit_on(pieces, name, place, &mut HashSet::new())
}

/// Like [`fit`], of the rest of a name; `tried` holds how much was left of pieces and name where these did not fit: of many
/// fields each may end in many places, and all ways to the same rest end alike.
fn fit_on<'a>(
    pieces: &'a [Piece],
    name: &'a str,
    place: &mut Place,
    tried: &mut HashSet<(usize, usize)>,
) -> Result<(), Stuck<'a>> {
    let stuck = |wanted| Err(Stuck { rest: name, wanted });
    let Some((piece, after)) = pieces.split_first() else {
        return if name.is_empty() { Ok(()) } else { stuck(None) };
    };
    match piece {
        Piece::Text(text) => match name.strip_prefix(text.as_str()) {
            Some(rest) => fit_on(after, rest, place, tried),
            None => stuck(Some(piece)),
        },
        Piece::Number(field) => {
            let digits = name.bytes().take_while(u8::is_ascii_digit).count();
            let (number, rest) = name.split_at(digits);
            let Ok(number) = number.parse() else {
                return stuck(Some(piece));
            };
            let slot = match field {
                Field::Section => &mut place.section,
                Field::Row => &mut place.row,
                Field::Column => &mut place.column,
            };
            *slot = number;
            fit_on(after, rest, place, tried)
        }
        Piece::Channel | Piece::Anything => {
            // What follows is text or the end: two names beside each other are refused.
            let ends: Vec<usize> = match after.first() {
                // Also where one begins within another.
                Some(Piece::Text(text)) => { name.char_indices() }
                    .map(|(at, _)| at)
                    .filter(|at| name[*at..].starts_with(text.as_str()))
                    .collect(),
                _ => vec![name.len()],
            };
            let mut farthest = Stuck {
                rest: name,
                wanted: if name.is_empty() || !ends.is_empty() {
                    Some(piece)
                } else {
                    after.first()
                },
            };
            for end in ends {
                if end == 0 && *piece == Piece::Channel {
                    continue;
                }
                let left = (after.len(), name.len() - end);
                if tried.contains(&left) {
                    continue;
                }
                let mut told = place.clone();
                if *piece == Piece::Channel {
                    told.channel = Some(name[..end].to_owned());
                }
                match fit_on(after, &name[end..], &mut told, tried) {
                    Ok(()) => {
                        *place = told;
                        return Ok(());
                    }
                    Err(stuck) => {
                        tried.insert(left);
                        if stuck.rest.len() < farthest.rest.len() {
                            farthest = stuck;
                        }
                    }
                }
            }
            Err(farthest)
        }
    }
}

impl FromStr for Pattern {
    type Err = PatternError;

    fn from_str(pattern: &str) -> Result<Self, PatternError> {
        let example = "s{section}/r{row}_c{column}.tif, with {channel} where there are several";
        let (parts, named) = parsed(pattern, example)?;
        if !named.contains(&"section") {
            return Err(PatternError {
                pattern: pattern.to_owned(),
                reason: "does not say where the number of the {section} is".to_owned(),
                example,
            });
        }
        Ok(Self { parts })
    }
}

/// The parts of a pattern, and the fields that it names.
fn parsed<'a>(
    pattern: &'a str,
    example: &'static str,
) -> Result<(Vec<Vec<Piece>>, Vec<&'a str>), PatternError> {
    let wrong = |reason: &str| PatternError {
        pattern: pattern.to_owned(),
        reason: reason.to_owned(),
        example,
    };
    let mut parts = Vec::new();
    let mut named = Vec::new();
    for part in pattern.split('/') {
        if matches!(part, "" | "." | "..") {
            return Err(wrong("has a folder without a name"));
        }
        let mut pieces: Vec<Piece> = Vec::new();
        let mut rest = part;
        while !rest.is_empty() {
            let text = rest.split('{').next().unwrap_or_default();
            if !text.is_empty() {
                pieces.push(Piece::Text(text.to_owned()));
                rest = &rest[text.len()..];
                continue;
            }
            let Some((field, after)) = rest[1..].split_once('}') else {
                return Err(wrong("has a { without its }"));
            };
            let piece = match field {
                "section" => Piece::Number(Field::Section),
                "row" => Piece::Number(Field::Row),
                "column" => Piece::Number(Field::Column),
                "channel" => Piece::Channel,
                "" => Piece::Anything,
                _ => return Err(wrong(&format!("has an unknown field {{{field}}}"))),
            };
            if !field.is_empty() && named.contains(&field) {
                return Err(wrong(&format!("says {{{field}}} twice")));
            }
            if pieces
                .last()
                .is_some_and(|last| !matches!(last, Piece::Text(_)))
            {
                return Err(wrong("has two fields with nothing between them"));
            }
            named.push(field);
            pieces.push(piece);
            rest = after;
        }
        parts.push(pieces);
    }
    Ok((parts, named))
}

impl fmt::Display for Pattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (n, part) in self.parts.iter().enumerate() {
            if n > 0 {
                f.write_str("/")?;
            }
            for piece in part {
                match piece {
                    Piece::Text(text) => f.write_str(text)?,
                    field => f.write_str(shown(Some(field)))?,
                }
            }
        }
        Ok(())
    }
}

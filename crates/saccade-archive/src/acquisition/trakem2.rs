//! TrakEM2 projects: the affine transform of every patch.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::path::Path;

use glam::UVec2;
use roxmltree::{Document, Node, ParsingOptions};
use saccade_core::transform::SectionFromTile;

use super::AcquisitionError;
use super::text::{content, quoted};
use super::tile_list::stem;
use crate::storage::read_regular;

/// A patch of a TrakEM2 project: a tile and where it lies.
#[derive(Clone, Debug, PartialEq)]
pub struct Patch {
    /// The image as the project names it.
    pub file: String,
    /// Section: the index of its layer, in order of z, from 0.
    pub section: u32,
    /// Width and height \[pixels\].
    pub size: UVec2,
    /// To pixels of the section from pixels of the tile.
    pub transform: SectionFromTile,
    /// Kinds of coordinate transform that are left out: what is not affine, such as deformations of the lens.
    pub left_out: Vec<String>,
}

impl Patch {
    /// The file's name without folder and extension: the tile's name.
    pub fn name(&self) -> &str {
        stem(&self.file)
    }
}

/// Reads the patches of a project, layer by layer.
///
/// Only the affine transform of a patch is understood; coordinate transforms that it carries besides are left out, which
/// [`Patch::left_out`] tells.
///
/// # Errors
///
/// [`AcquisitionError::Read`], [`AcquisitionError::Utf16`], [`AcquisitionError::Xml`], and [`AcquisitionError::Line`] for a patch
/// without a file, a size or an invertible transform.
pub fn read(path: &Path) -> Result<Vec<Patch>, AcquisitionError> {
    let bytes = read_regular(path).map_err(|source| AcquisitionError::Read {
        source,
        path: path.to_owned(),
    })?;
    parse(&bytes, path)
}

/// The same from the file's bytes; `path` is for messages.
///
/// # Errors
///
/// As [`read`], but for reading.
pub fn parse(bytes: &[u8], path: &Path) -> Result<Vec<Patch>, AcquisitionError> {
    let bytes = content(bytes, path)?;
    // TrakEM2 writes ISO 8859-1; what is not ASCII there can only be part of a name.
    let text = match std::str::from_utf8(bytes) {
        Ok(text) => Cow::Borrowed(text),
        Err(_) => bytes.iter().copied().map(char::from).collect(),
    };
    let options = ParsingOptions {
        allow_dtd: true,
        ..ParsingOptions::default()
    };
    let document = Document::parse_with_options(text.trim_start(), options).map_err(|source| {
        AcquisitionError::Xml {
            source,
            path: path.to_owned(),
        }
    })?;
    let wrong = |node: Node<'_, '_>, reason: String| AcquisitionError::Line {
        line: u64::from(document.text_pos_at(node.range().start).row),
        reason,
        path: path.to_owned(),
    };

    let mut layers = Vec::new();
    for layer in document
        .descendants()
        .filter(|n| n.has_tag_name("t2_layer"))
    {
        let z = attribute(layer, "z").and_then(|z| number(z, "z"));
        layers.push((z.map_err(|reason| wrong(layer, reason))?, layer));
    }
    layers.sort_by(|a, b| a.0.total_cmp(&b.0));

    let mut patches = Vec::new();
    for (section, (_, layer)) in (0..).zip(layers) {
        for node in layer.children().filter(|n| n.has_tag_name("t2_patch")) {
            patches.push(patch(node, section).map_err(|reason| wrong(node, reason))?);
        }
    }
    Ok(patches)
}

fn patch(node: Node<'_, '_>, section: u32) -> Result<Patch, String> {
    let file = attribute(node, "file_path")?.to_owned();
    // `width` may be that of a deformed image; `o_width` is the file's.
    let side = |original, shown| -> Result<u32, String> {
        let text = node
            .attribute(original)
            .map_or_else(|| attribute(node, shown), Ok)?;
        let value = number(text, shown)?;
        if (1.0..=f64::from(u32::MAX)).contains(&value) && value.fract() == 0.0 {
            #[expect(clippy::cast_possible_truncation, reason = "checked above")]
            Ok(value as u32)
        } else {
            Err(format!("{shown} is {value}, which is no number of pixels"))
        }
    };
    let size = UVec2::new(side("o_width", "width")?, side("o_height", "height")?);
    let transform = attribute(node, "transform")?;
    let elements = matrix(transform).ok_or_else(|| {
        format!(
            "transform is {}, not `matrix(a,b,c,d,tx,ty)`",
            quoted(transform)
        )
    })?;
    let transform = SectionFromTile::new(elements).map_err(|e| e.to_string())?;
    let more = node
        .descendants()
        .filter(|n| n.has_tag_name("ict_transform"));
    let kinds = more.map(|more| {
        let class = more.attribute("class").unwrap_or_default();
        class.rsplit('.').next().unwrap_or_default().to_owned()
    });
    Ok(Patch {
        file,
        section,
        size,
        transform,
        left_out: kinds.collect(),
    })
}

/// What is to be said of coordinate transforms that are left out, if there are any.
pub fn left_out(patches: &[Patch], path: &Path) -> Option<String> {
    let mut of = patches.iter().filter(|patch| !patch.left_out.is_empty());
    let first = of.next()?;
    let kinds: BTreeSet<&str> = { patches.iter() }
        .flat_map(|patch| patch.left_out.iter().map(String::as_str))
        .collect();
    let kinds: Vec<_> = kinds.into_iter().collect();
    Some(format!(
        "of {} tiles, such as {:?}, the affine transform alone is used: coordinate transforms ({}) cannot be, so that \
         they lie where the project has them but are not deformed; let TrakEM2 apply them to the images, or use \
         affine transforms only: {}",
        1 + of.count(),
        first.name(),
        kinds.join(", "),
        path.display()
    ))
}

fn attribute<'a>(node: Node<'a, '_>, name: &str) -> Result<&'a str, String> {
    let tag = node.tag_name().name();
    node.attribute(name)
        .ok_or_else(|| format!("<{tag}> has no {name}"))
}

fn number(text: &str, what: &str) -> Result<f64, String> {
    text.trim()
        .parse()
        .map_err(|_| format!("{what} is {}, which is no number", quoted(text)))
}

fn matrix(text: &str) -> Option<[f64; 6]> {
    let inside = text.trim().strip_prefix("matrix(")?.strip_suffix(')')?;
    let numbers: Result<Vec<f64>, _> = inside.split(',').map(|n| n.trim().parse()).collect();
    numbers.ok()?.try_into().ok()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    const HEAD: &str = "\n<?xml version=\"1.0\" encoding=\"ISO-8859-1\"?>\n<!DOCTYPE trakem2_anything [\n<!ELEMENT trakem2 (project)>\n]>\n";

    fn project(layers: &str) -> Result<Vec<Patch>, AcquisitionError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("project.xml");
        fs::write(
            &path,
            format!("{HEAD}<trakem2><t2_layer_set>{layers}</t2_layer_set></trakem2>"),
        )
        .unwrap();
        read(&path)
    }

    #[test]
    fn layers_become_sections_in_order_of_z() {
        let patch = |file: &str| {
            format!(
                r#"<t2_patch width="9.0" height="7.0" o_width="8" o_height="6"
                    transform="matrix(1,0.5,-0.5,1,10,20)" file_path="/x/{file}.tif"/>"#
            )
        };
        let layers = format!(
            r#"<t2_layer z="3.0">{}</t2_layer><t2_layer z="0.5">{}{}</t2_layer>"#,
            patch("c"),
            patch("a"),
            patch("b"),
        );
        let patches = project(&layers).unwrap();
        let order: Vec<_> = patches.iter().map(|p| (p.name(), p.section)).collect();
        assert_eq!(order, [("a", 0), ("b", 0), ("c", 1)]);
        assert_eq!(patches[0].size, UVec2::new(8, 6));
        assert_eq!(
            patches[0].transform.elements(),
            [1.0, 0.5, -0.5, 1.0, 10.0, 20.0]
        );
    }

    #[test]
    fn what_is_not_affine_is_left_out_and_told() {
        let patch = |name: &str, more: &str| {
            format!(
                r#"<t2_patch width="9" height="7" transform="matrix(1,0,0,1,3,4)" file_path="{name}.tif">{more}</t2_patch>"#
            )
        };
        let more = r#"<ict_transform_list><ict_transform class="lenscorrection.NonLinearTransform" data="5 1"/>
            <ict_transform class="some.Spline" data=""/></ict_transform_list>"#;
        let all = [patch("a", ""), patch("b", more), patch("c", more)].concat();
        let patches = project(&format!("<t2_layer z=\"0\">{all}</t2_layer>")).unwrap();
        assert_eq!(patches[1].left_out, ["NonLinearTransform", "Spline"]);
        assert_eq!(patches[1].transform.elements()[4..], [3.0, 4.0]);
        let path = Path::new("project.xml");
        let said = left_out(&patches, path).unwrap();
        for part in [
            "2 tiles",
            "\"b\"",
            "NonLinearTransform, Spline",
            "affine",
            "project.xml",
        ] {
            assert!(said.contains(part), "{said}");
        }
        assert_eq!(left_out(&patches[..1], path), None);
    }

    #[test]
    fn broken_patches_are_refused_with_their_line() {
        for patch in [
            r#"<t2_patch width="9" height="7" transform="matrix(1,0,0,1,0,0)"/>"#,
            r#"<t2_patch file_path="a" width="9" height="7" transform="rotate(3)"/>"#,
            r#"<t2_patch file_path="a" width="9" height="7" transform="matrix(0,0,0,0,1,1)"/>"#,
            r#"<t2_patch file_path="a" width="9.5" height="7" transform="matrix(1,0,0,1,0,0)"/>"#,
        ] {
            let read = project(&format!("<t2_layer z=\"0\">\n{patch}</t2_layer>"));
            assert!(
                matches!(read, Err(AcquisitionError::Line { .. })),
                "{patch}: {read:?}"
            );
        }
        assert!(matches!(
            project("<t2_layer"),
            Err(AcquisitionError::Xml { .. })
        ));
    }
}

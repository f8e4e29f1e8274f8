//! The page that lists the volumes, with links that open them in other viewers.

use std::fmt::Write;

use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, HOST, HeaderMap};
use axum::response::{Html, IntoResponse, Response};
use saccade_core::volume::Volume;
use serde_json::json;

use crate::formats::Format;
use crate::volumes::Volumes;

const PAGE: &str = include_str!("index/page.html");
/// Scripts have no business here, whatever a volume is called.
const POLICY: &str = "default-src 'none'; img-src 'self'; style-src 'unsafe-inline'";

/// The page as the client of a request sees the server.
pub(crate) fn index(volumes: &Volumes, request: &HeaderMap) -> Response {
    let base = base(request);
    let mut articles = String::new();
    for published in volumes.all() {
        articles += &article(published.volume(), &published.version(), &base);
    }
    for (name, cause) in volumes.failing() {
        let (name, cause) = (escaped(&name), escaped(&cause));
        // Writing to a string cannot fail.
        let _ = write!(
            articles,
            "<article>\n<a></a>\n<div>\n<h2>{name}</h2>\n<p>cannot be opened now, and is tried again: {cause}</p>\n</div>\n\
             </article>\n"
        );
    }
    if articles.is_empty() {
        articles = "<p>There are none yet. This page lists them as they appear.</p>".to_owned();
    }
    let headers = [
        (CACHE_CONTROL, "no-cache"),
        (CONTENT_SECURITY_POLICY, POLICY),
    ];
    (headers, Html(PAGE.replace("{{volumes}}", &articles))).into_response()
}

/// Scheme and host by which the client reached this server, perhaps through a proxy.
fn base(request: &HeaderMap) -> String {
    let text = |name| request.get(name).and_then(|value| value.to_str().ok());
    let scheme = match text("x-forwarded-proto") {
        Some("https") => "https",
        _ => "http",
    };
    format!("{scheme}://{}", text(HOST.as_str()).unwrap_or("localhost"))
}

/// One volume: its picture, its facts, its addresses.
fn article(volume: &Volume, version: &str, base: &str) -> String {
    let name = escaped(&volume.name);
    let path = encoded(&volume.name);
    let [x, y, z] = volume.extent().to_array();
    let nm = volume.voxel_nm;
    let levels = volume.levels.len();
    let open = escaped(&format!("./?volume={path}"));
    let mut html = format!(
        "<article>\n<a href=\"{open}\"><img src=\"v/{path}/thumbnail.png\" alt=\"a section of {name}\" \
         loading=\"lazy\"></a>\n<div>\n<h2>{name}</h2>\n<p>{x} × {y} × {z} voxels of {} × {} × {} nm, \
         {levels} levels</p>\n<p>Open in <a href=\"{open}\">Saccade</a>",
        nm.x, nm.y, nm.z
    );
    for (viewer, link) in links(volume, version, base) {
        // Writing to a string cannot fail.
        let _ = write!(html, " · <a href=\"{}\">{viewer}</a>", escaped(&link));
    }
    html += "</p>\n<dl>\n";
    for format in Format::ALL {
        let name = match format {
            Format::Zarr3 => "OME-Zarr 0.5",
            Format::Zarr2 => "OME-Zarr 0.4",
            Format::Precomputed => "precomputed",
        };
        let address = escaped(&format!("{base}/v/{path}/{}/", format.folder()));
        let _ = writeln!(html, "<dt>{name}</dt><dd><code>{address}</code></dd>");
    }
    html + "</dl>\n</div>\n</article>\n"
}

/// Viewers and the addresses that open a volume in them.
fn links(volume: &Volume, version: &str, base: &str) -> [(&'static str, String); 3] {
    let name = &*volume.name;
    // These viewers keep what they have fetched: a new version must have a new address.
    let address = |format: Format| {
        let (name, version) = (encoded(name), encoded(version));
        format!("{base}/v/{name}/at/{version}/{}", format.folder())
    };
    let zarr = address(Format::Zarr3);
    // Segmentations have no channels, and precomputed says that it has none.
    let (kind, source) = match volume.kind.is_labels() && volume.channels.len() == 1 {
        true => {
            let precomputed = address(Format::Precomputed);
            (
                "segmentation",
                format!("{precomputed}/|neuroglancer-precomputed:"),
            )
        }
        false => ("image", format!("{zarr}/|zarr3:")),
    };
    let state = json!({
        "layers": [{ "type": kind, "name": name, "source": source }],
        "selectedLayer": { "layer": name, "visible": true },
        "layout": "4panel",
    });
    let state = encoded(&state.to_string());
    let zarr = encoded(&zarr);
    [
        (
            "Neuroglancer",
            format!("https://neuroglancer-demo.appspot.com/#!{state}"),
        ),
        (
            "vizarr",
            format!("https://hms-dbmi.github.io/vizarr/?source={zarr}"),
        ),
        (
            "OME-NGFF Validator",
            format!("https://ome.github.io/ome-ngff-validator/?source={zarr}"),
        ),
    ]
}

/// For text and quoted attributes of HTML.
fn escaped(text: &str) -> String {
    let mut html = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => html += "&amp;",
            '<' => html += "&lt;",
            '>' => html += "&gt;",
            '"' => html += "&quot;",
            '\'' => html += "&#39;",
            other => html.push(other),
        }
    }
    html
}

/// For one segment, or one value, of an address.
fn encoded(text: &str) -> String {
    let mut address = String::with_capacity(text.len());
    for byte in text.bytes() {
        if byte.is_ascii_alphanumeric() || b"-._~".contains(&byte) {
            address.push(char::from(byte));
        } else {
            let _ = write!(address, "%{byte:02X}");
        }
    }
    address
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DVec3, UVec3};
    use saccade_core::volume::VoxelKind;

    #[test]
    fn names_cannot_leave_their_place() {
        let name = "a<b>\"'&/../c d?";
        let volume = Volume::new(name, UVec3::ONE, DVec3::ONE).unwrap();
        let html = article(&volume, "0-1", "http://host");
        assert!(
            html.contains("a&lt;b&gt;&quot;&#39;&amp;/../c d?</h2>"),
            "{html}"
        );
        let path = "a%3Cb%3E%22%27%26%2F..%2Fc%20d%3F";
        assert!(html.contains(&format!("src=\"v/{path}/thumbnail.png\"")));
        assert!(html.contains(&format!("<code>http://host/v/{path}/zarr2/</code>")));
    }

    #[test]
    fn links_carry_the_version_and_the_way_the_client_came() {
        let mut request = HeaderMap::new();
        request.insert(HOST, "em.lab:8080".parse().unwrap());
        assert_eq!(base(&request), "http://em.lab:8080");
        request.insert("x-forwarded-proto", "https".parse().unwrap());
        assert_eq!(base(&request), "https://em.lab:8080");
        let mut volume = Volume::new("fly", UVec3::ONE, DVec3::ONE).unwrap();
        for (viewer, link) in &links(&volume, "ab-7", &base(&request)) {
            let source = encoded("https://em.lab:8080/v/fly/at/ab-7/zarr");
            assert!(link.contains(&source), "{viewer}: {link}");
        }
        volume.kind = VoxelKind::Labels;
        let [(_, neuroglancer), ..] = links(&volume, "ab-7", &base(&request));
        for part in ["segmentation", "/v/fly/at/ab-7/precomputed/"] {
            assert!(neuroglancer.contains(&encoded(part)), "{neuroglancer}");
        }
    }
}

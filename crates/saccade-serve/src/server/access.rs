//! By which names a server answers, and to whose pages.
//!
//! A browser lets a page read what comes from the page's own origin. A page of a stranger can make
//! its name point to this computer afterwards, and is then of the same origin as this server: its
//! requests carry the stranger's name. So a server answers only to names that it has; addresses
//! in numbers, which cannot be made to point elsewhere, are always right.

use std::collections::BTreeSet;
use std::net::{Ipv4Addr, Ipv6Addr};

use axum::http::header::{HOST, HeaderMap, ORIGIN};
use axum::http::uri::Authority;
use axum::http::{StatusCode, Version};
use axum::response::Response;

use crate::http::refusal;

/// Who may ask.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Access {
    /// Names by which clients may call the server, besides those that are its own: `localhost`,
    /// addresses in numbers, and the computer's name. Without port.
    pub hosts: Vec<String>,
    /// Pages whose scripts may read.
    pub origins: Origins,
}

/// Pages whose scripts may read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origins {
    /// All: any viewer can open the volumes.
    Any,
    /// The server's own, and those of exactly these origins, such as `https://viewer.example`.
    Only(Vec<String>),
}

impl Access {
    /// The server's own names; all pages.
    pub const DEFAULT: Self = Self {
        hosts: Vec::new(),
        origins: Origins::Any,
    };
}

impl Default for Access {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// Decides who may ask.
#[derive(Debug)]
pub(crate) struct Gate {
    names: BTreeSet<String>,
    origins: Origins,
}

impl Gate {
    pub(crate) fn new(access: &Access) -> Self {
        Self::of(access, own_name().as_deref())
    }

    fn of(access: &Access, own: Option<&str>) -> Self {
        let names = access.hosts.iter().map(String::as_str);
        let own = own.into_iter();
        let local = own.flat_map(|name| [name.to_owned(), format!("{name}.local")]);
        Self {
            names: names
                .map(str::to_owned)
                .chain(local)
                .map(|name| name.trim_end_matches('.').to_ascii_lowercase())
                .collect(),
            origins: access.origins.clone(),
        }
    }

    /// The answer to a request that may not be made. `target` is the host that it is for by its first line, where that names one.
    pub(crate) fn refuse(
        &self,
        version: Version,
        target: Option<&str>,
        headers: &HeaderMap,
    ) -> Option<Response> {
        let mut hosts = headers.get_all(HOST).iter();
        let host = match (hosts.next(), hosts.next()) {
            (Some(host), None) => host.to_str().ok().and_then(|h| h.parse::<Authority>().ok()),
            // Older clients may say nothing; browsers are never as old.
            (None, _) if version < Version::HTTP_11 => return None,
            _ => None,
        };
        let Some(host) = host else {
            let error = "a request must name one host, and only one";
            return Some(refusal(StatusCode::BAD_REQUEST, error, Vec::new()));
        };
        let mut names = [target, Some(host.host())].into_iter().flatten();
        if let Some(other) = names.find(|name| !self.is_own(name)) {
            let error = format!(
                "this server does not go by the name {other:?}; --allow-host gives it another name"
            );
            let known = self.names.iter().cloned().chain(["localhost".to_owned()]);
            return Some(refusal(
                StatusCode::MISDIRECTED_REQUEST,
                error,
                known.collect(),
            ));
        }
        let Origins::Only(allowed) = &self.origins else {
            return None;
        };
        let origin = headers.get(ORIGIN)?.to_str().unwrap_or_default();
        let own = origin
            .split_once("://")
            .is_some_and(|(_, from)| from == host.as_str());
        if own || allowed.iter().any(|allowed| allowed == origin) {
            return None;
        }
        let error = format!("pages of {origin:?} may not read here; --allow-origin lets them");
        Some(refusal(StatusCode::FORBIDDEN, error, Vec::new()))
    }

    fn is_own(&self, host: &str) -> bool {
        let name = host.trim_end_matches('.').to_ascii_lowercase();
        let in_brackets = name.strip_prefix('[').and_then(|n| n.strip_suffix(']'));
        let number = name.parse::<Ipv4Addr>().is_ok()
            || in_brackets.is_some_and(|name| name.parse::<Ipv6Addr>().is_ok());
        number || name == "localhost" || name.ends_with(".localhost") || self.names.contains(&name)
    }
}

/// The computer's name, where Linux or its files say it.
fn own_name() -> Option<String> {
    let name = ["/proc/sys/kernel/hostname", "/etc/hostname"]
        .into_iter()
        .find_map(|file| std::fs::read_to_string(file).ok())?;
    let name = name.trim();
    (!name.is_empty()).then(|| name.to_owned())
}

/// The host that a request is for, by its first line and by its header, and the page that it comes from: three lines. Names of
/// strangers are never answered.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz(bytes: &[u8]) {
    use axum::http::HeaderValue;

    let lines: Vec<&[u8]> = bytes.splitn(3, |b| *b == b'\n').collect();
    let &[target, host, origin] = &lines[..] else {
        return;
    };
    let target = std::str::from_utf8(target)
        .ok()
        .filter(|target| !target.is_empty());
    let [Ok(host), Ok(origin)] = [host, origin].map(HeaderValue::from_bytes) else {
        return;
    };
    let access = Access {
        hosts: vec!["em.lab.example".to_owned()],
        origins: Origins::Only(vec!["https://viewer.example".to_owned()]),
    };
    let gate = Gate::of(&access, Some("microscope"));
    let mut headers = HeaderMap::from_iter([(HOST, host.clone())]);
    let status = |headers: &HeaderMap| {
        let refusal = gate.refuse(Version::HTTP_11, target, headers);
        refusal.map(|answer| answer.status())
    };
    if status(&headers).is_none() {
        let host = host.to_str().expect("it was understood");
        let authority: Authority = host.parse().expect("it was understood");
        for name in target.into_iter().chain([authority.host()]) {
            let name = name.to_ascii_lowercase();
            let name = name
                .trim_end_matches('.')
                .rsplit('.')
                .next()
                .unwrap_or_default();
            let is_known = ["localhost", "microscope", "local", "example"].contains(&name);
            let is_number = name.ends_with(']') || name.parse::<u8>().is_ok();
            assert!(is_known || is_number, "{name:?} is a stranger's");
        }
        // Pages of strangers are not, either.
        headers.insert(ORIGIN, origin.clone());
        if status(&headers).is_none() {
            let origin = origin.to_str().expect("it was understood");
            let own = origin.ends_with(&format!("://{authority}"));
            assert!(own || origin == "https://viewer.example", "{origin:?}");
        }
    }
    headers.append(HOST, host);
    assert_eq!(status(&headers), Some(StatusCode::BAD_REQUEST), "two hosts");
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderName;

    fn gate(origins: Origins) -> Gate {
        let access = Access {
            hosts: vec!["em.lab.example".to_owned()],
            origins,
        };
        Gate::of(&access, Some("Microscope"))
    }

    fn ask(gate: &Gate, headers: &[(HeaderName, &str)]) -> Option<u16> {
        ask_for(gate, None, headers)
    }

    fn ask_for(gate: &Gate, target: Option<&str>, headers: &[(HeaderName, &str)]) -> Option<u16> {
        let headers = headers
            .iter()
            .map(|(name, value)| (name.clone(), value.parse().unwrap()));
        let mut map = HeaderMap::new();
        headers.for_each(|(name, value)| _ = map.append(name, value));
        gate.refuse(Version::HTTP_11, target, &map)
            .map(|refusal| refusal.status().as_u16())
    }

    #[test]
    fn a_server_goes_by_its_names_only() {
        let gate = gate(Origins::Any);
        for own in [
            "localhost",
            "localhost:8080",
            "127.0.0.1:80",
            "[::1]:8080",
            "10.1.2.3",
            "microscope",
            "MICROSCOPE.local:1",
            "em.lab.example.",
            "EM.lab.example:8080",
            "a.localhost",
        ] {
            assert_eq!(ask(&gate, &[(HOST, own)]), None, "{own}");
        }
        for other in [
            "evil.example",
            "localhost.evil.example",
            "em.lab.example.evil.example",
            "127.0.0.1.evil.example",
            "xem.lab.example",
            "microscope.evil.example",
        ] {
            assert_eq!(ask(&gate, &[(HOST, other)]), Some(421), "{other}");
        }
        for nonsense in ["", " ", "a b", "localhost/", "[::1"] {
            let refused = ask(&gate, &[(HOST, nonsense)]);
            assert!(
                matches!(refused, Some(400 | 421)),
                "{nonsense:?}: {refused:?}"
            );
        }
        assert_eq!(ask(&gate, &[]), Some(400));
        // The first line of a request may name a host as well.
        let own = [(HOST, "localhost")];
        assert_eq!(ask_for(&gate, Some("evil.example"), &own), Some(421));
        assert_eq!(ask_for(&gate, Some("localhost"), &own), None);
        let two = [(HOST, "localhost"), (HOST, "evil.example")];
        assert_eq!(ask(&gate, &two), Some(400));
        assert!(
            gate.refuse(Version::HTTP_10, None, &HeaderMap::new())
                .is_none()
        );
    }

    #[test]
    fn origins_are_exact() {
        let only = gate(Origins::Only(vec!["https://viewer.example".to_owned()]));
        let from = |origin| ask(&only, &[(HOST, "localhost:8080"), (ORIGIN, origin)]);
        assert_eq!(
            ask(&only, &[(HOST, "localhost:8080")]),
            None,
            "no page at all"
        );
        for good in ["https://viewer.example", "http://localhost:8080"] {
            assert_eq!(from(good), None, "{good}");
        }
        for bad in [
            "http://viewer.example",
            "https://viewer.example:444",
            "https://viewer.example.evil.example",
            "https://xviewer.example",
            "null",
            "",
            "http://localhost:9999",
            "http://localhost",
        ] {
            assert_eq!(from(bad), Some(403), "{bad}");
        }
        let any = gate(Origins::Any);
        assert_eq!(ask(&any, &[(HOST, "localhost"), (ORIGIN, "null")]), None);
    }
}

//! Which process this is, and whether another is still there: a worker that was killed on this machine
//! need not be waited for.

use std::fs;

/// Tells this process from all others, here and on other machines, now and later; `None` where that cannot be
/// told.
///
/// The machine since it was started, the namespace in which processes are numbered, the number, and when it
/// began: numbers are used again.
pub(super) fn this() -> Option<String> {
    let place = place()?;
    let number = std::process::id();
    let began = began(number)?;
    Some(format!("{place}/{number}/{began}"))
}

/// Whether a process is known to have ended: it was one of this machine and namespace, and is no more.
pub(super) fn is_gone(process: &str) -> bool {
    let mut parts = process.rsplitn(3, '/');
    let (Some(then), Some(number), Some(of)) = (parts.next(), parts.next(), parts.next()) else {
        return false;
    };
    let Ok(number) = number.parse() else {
        return false;
    };
    // Elsewhere nothing is known.
    place().as_deref() == Some(of) && began(number).as_deref() != Some(then)
}

/// The machine since it was started, and the namespace.
fn place() -> Option<String> {
    let machine = fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?;
    let namespace = fs::read_link("/proc/self/ns/pid").ok()?;
    Some(format!("{} {}", machine.trim(), namespace.to_str()?))
}

/// When a process began \[ticks\]; `None` if it is not there, or only its parent has not heard yet that it ended.
fn began(number: u32) -> Option<String> {
    let stat = fs::read_to_string(format!("/proc/{number}/stat")).ok()?;
    // The name, in brackets, may hold anything.
    let (_, stat) = stat.rsplit_once(')')?;
    let mut fields = stat.split_whitespace();
    let state = fields.next()?;
    let began = fields.nth(18)?;
    (!matches!(state, "Z" | "X")).then(|| began.to_owned())
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests {
    use super::*;
    use std::process::{Command, Stdio};

    #[test]
    fn processes_are_told_apart() {
        let this = this().unwrap();
        assert!(!is_gone(&this));
        let mut child = Command::new("cat").stdin(Stdio::piped()).spawn().unwrap();
        let place = place().unwrap();
        let name = format!("{place}/{}/{}", child.id(), began(child.id()).unwrap());
        assert!(!is_gone(&name));
        child.kill().unwrap();
        // Not waited for yet, it is a zombie.
        while !is_gone(&name) {
            std::thread::yield_now();
        }
        child.wait().unwrap();
        assert!(is_gone(&name));
        // One that got this one's number later, or earlier.
        let other = format!("{place}/{}/1", std::process::id());
        assert!(is_gone(&other));
        // Of others nothing is known.
        for unknown in ["", "a", "x/y/z", "elsewhere pid:[1]/1/1", "//"] {
            assert!(!is_gone(unknown), "{unknown}");
        }
    }
}

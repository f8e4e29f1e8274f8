use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::io;
use std::ops::Range;
use std::path::{Component, Path};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use tokio::sync::watch;

use super::{DirEntry, Disk, FolderId, Metadata, OpenFile};

/// A file system in memory whose power can be cut after any step.
///
/// What a power cut leaves is what was synced, and any part of what was not: of a file's bytes any
/// number, the last ones possibly as zeros, or any of its sectors; of a folder's changes any subset, a rename being one
/// change in each of two folders. So it keeps what every file system keeps, and no more. Clones share
/// it.
#[derive(Clone, Debug)]
pub struct SimulatedDisk {
    state: Arc<Mutex<State>>,
    off: watch::Sender<bool>,
}

/// Chooses what a power cut leaves: seeds of the same number choose the same.
#[derive(Clone, Debug)]
pub struct Crash(u64);

#[derive(Clone, Debug, Default)]
struct State {
    nodes: Vec<Node>,
    /// Steps taken: each call that changes or syncs something.
    steps: u64,
    /// The step at which the power is cut.
    cut_at: Option<u64>,
    /// Steps at which a sync fails.
    failing_syncs: BTreeSet<u64>,
    /// Nodes of files that somebody has locked.
    locked: BTreeSet<usize>,
}

#[derive(Clone, Debug)]
enum Node {
    File {
        bytes: Vec<u8>,
        /// How many of the first bytes are durable.
        durable: usize,
    },
    Dir {
        entries: BTreeMap<OsString, usize>,
        durable: BTreeMap<OsString, usize>,
        /// Since the last sync, in order.
        changes: Vec<Change>,
    },
}

/// A name that means something else, or nothing, now.
type Change = (OsString, Option<usize>);

const ROOT: usize = 0;
/// What a disk writes whole or not at all \[bytes\].
const SECTOR: usize = 512;

impl Node {
    fn dir() -> Self {
        Self::Dir {
            entries: BTreeMap::new(),
            durable: BTreeMap::new(),
            changes: Vec::new(),
        }
    }
}

impl Default for SimulatedDisk {
    fn default() -> Self {
        Self::new()
    }
}

impl SimulatedDisk {
    /// An empty file system.
    pub fn new() -> Self {
        Self::of(State {
            nodes: vec![Node::dir()],
            ..State::default()
        })
    }

    fn of(state: State) -> Self {
        Self {
            state: Arc::new(Mutex::new(state)),
            off: watch::Sender::new(false),
        }
    }

    /// Steps taken so far.
    pub fn steps(&self) -> u64 {
        self.state().steps
    }

    /// Cuts the power when the `nth` step from now would be taken, 0 being the next: it is not
    /// taken, and everything fails from then on.
    pub fn cut_power_at(&self, nth: u64) {
        let mut state = self.state();
        state.cut_at = Some(state.steps + nth);
    }

    /// Makes the `nth` step from now fail if it is a sync, as a disk with errors does: what it should
    /// have made durable counts as durable from then on, but is not.
    pub fn fail_sync_at(&self, nth: u64) {
        let mut state = self.state();
        let at = state.steps + nth;
        state.failing_syncs.insert(at);
    }

    /// Returns when the power is off.
    pub async fn power_is_off(&self) {
        let mut off = self.off.subscribe();
        // The sender lives as long as this does.
        let _ = off.wait_for(|off| *off).await;
    }

    /// The file system as it may be found after a power cut now. This one stays as it is, so that
    /// another crash can be tried.
    pub fn after_crash(&self, crash: &mut Crash) -> Self {
        let old = self.state();
        let mut new = State {
            nodes: vec![Node::dir()],
            ..State::default()
        };
        copy_what_is_left(&old, ROOT, &mut new, ROOT, crash);
        Self::of(new)
    }

    /// All that is there, with a slash at the end of folders.
    pub fn tree(&self) -> Vec<String> {
        let state = self.state();
        let mut found = Vec::new();
        state.walk(ROOT, "", &mut found);
        found
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // A test that panicked in between fails anyway.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Begins a step, unless the power is off. Tells whether it is to fail if it is a sync.
    fn step(&self) -> io::Result<(MutexGuard<'_, State>, bool)> {
        let mut state = self.powered()?;
        if state.cut_at == Some(state.steps) {
            drop(state);
            self.off.send_replace(true);
            return Err(off());
        }
        let number = state.steps;
        state.steps += 1;
        let fails = state.failing_syncs.remove(&number);
        Ok((state, fails))
    }

    fn powered(&self) -> io::Result<MutexGuard<'_, State>> {
        if *self.off.borrow() {
            Err(off())
        } else {
            Ok(self.state())
        }
    }
}

fn off() -> io::Error {
    io::Error::other("the power is off")
}

fn failed_sync() -> io::Error {
    io::Error::from_raw_os_error(5) // EIO
}

impl State {
    fn find(&self, path: &Path) -> io::Result<usize> {
        let mut at = ROOT;
        for part in path.components() {
            let Component::Normal(part) = part else {
                continue;
            };
            let Node::Dir { entries, .. } = &self.nodes[at] else {
                return Err(io::ErrorKind::NotADirectory.into());
            };
            at = *entries.get(part).ok_or(io::ErrorKind::NotFound)?;
        }
        Ok(at)
    }

    /// The folder that a path is in, and its name there.
    fn place(&self, path: &Path) -> io::Result<(usize, OsString)> {
        let name = path.file_name().ok_or(io::ErrorKind::InvalidInput)?;
        let folder = self.find(path.parent().unwrap_or(Path::new("")))?;
        Ok((folder, name.to_owned()))
    }

    fn lookup(&self, folder: usize, name: &OsString) -> io::Result<Option<usize>> {
        match &self.nodes[folder] {
            Node::Dir { entries, .. } => Ok(entries.get(name).copied()),
            Node::File { .. } => Err(io::ErrorKind::NotADirectory.into()),
        }
    }

    fn change(&mut self, folder: usize, name: OsString, to: Option<usize>) {
        if let Node::Dir {
            entries, changes, ..
        } = &mut self.nodes[folder]
        {
            apply(entries, &(name.clone(), to));
            changes.push((name, to));
        }
    }

    /// Makes a node under a name that is free.
    fn create(&mut self, path: &Path, node: Node) -> io::Result<usize> {
        let (folder, name) = self.place(path)?;
        if self.lookup(folder, &name)?.is_some() {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        self.nodes.push(node);
        let made = self.nodes.len() - 1;
        self.change(folder, name, Some(made));
        Ok(made)
    }

    fn rename(&mut self, from: &Path, to: &Path) -> io::Result<()> {
        let (old_folder, old_name) = self.place(from)?;
        let (new_folder, new_name) = self.place(to)?;
        let node = self.lookup(old_folder, &old_name)?;
        let node = node.ok_or(io::ErrorKind::NotFound)?;
        if let Some(there) = self.lookup(new_folder, &new_name)?
            && matches!(self.nodes[there], Node::Dir { .. })
        {
            return Err(io::ErrorKind::IsADirectory.into());
        }
        // Two names of one file, or the same name twice: nothing happens.
        if self.lookup(new_folder, &new_name)? == Some(node) {
            return Ok(());
        }
        self.change(new_folder, new_name, Some(node));
        self.change(old_folder, old_name, None);
        Ok(())
    }

    fn walk(&self, at: usize, name: &str, found: &mut Vec<String>) {
        match &self.nodes[at] {
            Node::File { .. } => found.push(name.to_owned()),
            Node::Dir { entries, .. } => {
                for (part, node) in entries {
                    let part = part.to_string_lossy();
                    let slash = matches!(self.nodes[*node], Node::Dir { .. });
                    let below = format!("{name}{part}{}", if slash { "/" } else { "" });
                    if slash {
                        found.push(below.clone());
                    }
                    self.walk(*node, &below, found);
                }
            }
        }
    }
}

fn apply(entries: &mut BTreeMap<OsString, usize>, (name, to): &Change) {
    match to {
        Some(node) => entries.insert(name.clone(), *node),
        None => entries.remove(name),
    };
}

/// Copies a folder's durable entries and a random part of its other changes, with all below.
fn copy_what_is_left(old: &State, from: usize, new: &mut State, to: usize, crash: &mut Crash) {
    let Node::Dir {
        durable, changes, ..
    } = &old.nodes[from]
    else {
        return;
    };
    let mut left = durable.clone();
    for change in changes {
        if crash.below(2) == 0 {
            apply(&mut left, change);
        }
    }
    for (name, node) in left {
        let copied = match &old.nodes[node] {
            Node::File { bytes, durable } => {
                let bytes = bytes_left(bytes, *durable, crash);
                let durable = bytes.len();
                Node::File { bytes, durable }
            }
            Node::Dir { .. } => Node::dir(),
        };
        new.nodes.push(copied);
        let copy = new.nodes.len() - 1;
        if let Node::Dir {
            entries, durable, ..
        } = &mut new.nodes[to]
        {
            entries.insert(name.clone(), copy);
            durable.insert(name, copy);
        }
        copy_what_is_left(old, node, new, copy, crash);
    }
}

fn bytes_left(bytes: &[u8], durable: usize, crash: &mut Crash) -> Vec<u8> {
    let pending = bytes.len() - durable;
    let some = |crash: &mut Crash| durable + crash.below(pending + 1);
    match crash.below(5) {
        0 => bytes[..durable].to_vec(),
        1 => bytes.to_vec(),
        2 => bytes[..some(crash)].to_vec(),
        // The length is there, the bytes are not.
        3 => {
            let kept = some(crash);
            let mut left = bytes.to_vec();
            left[kept..].fill(0);
            left
        }
        // Each sector for itself, in whatever order the disk took them.
        _ => {
            let mut left = bytes.to_vec();
            let mut first = durable;
            while first < left.len() {
                let end = (first / SECTOR * SECTOR + SECTOR).min(left.len());
                if crash.below(2) == 0 {
                    left[first..end].fill(0);
                }
                first = end;
            }
            left
        }
    }
}

impl Crash {
    /// Crashes as this seed has them.
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// SplitMix64, of Steele, Lea and Flood, "Fast splittable pseudorandom number generators".
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        usize::try_from(self.next() % n as u64).unwrap_or(0)
    }
}

struct SimulatedFile {
    disk: SimulatedDisk,
    node: usize,
    locked: bool,
}

impl OpenFile for SimulatedFile {
    fn lock(&mut self) {
        self.locked = true;
        self.disk.state().locked.insert(self.node);
    }

    fn write_all(&mut self, more: &[u8]) -> io::Result<()> {
        let (mut state, _) = self.disk.step()?;
        if let Node::File { bytes, .. } = &mut state.nodes[self.node] {
            bytes.extend_from_slice(more);
        }
        Ok(())
    }

    fn sync(&mut self) -> io::Result<()> {
        let (mut state, fails) = self.disk.step()?;
        if let Node::File { bytes, durable } = &mut state.nodes[self.node] {
            if fails {
                // Memory forgets what the disk did not take.
                bytes[*durable..].fill(0);
            }
            *durable = bytes.len();
        }
        if fails { Err(failed_sync()) } else { Ok(()) }
    }
}

impl Drop for SimulatedFile {
    fn drop(&mut self) {
        if self.locked {
            self.disk.state().locked.remove(&self.node);
        }
    }
}

impl Disk for SimulatedDisk {
    fn create_new(&self, path: &Path) -> io::Result<Box<dyn OpenFile>> {
        let (mut state, _) = self.step()?;
        let file = Node::File {
            bytes: Vec::new(),
            durable: 0,
        };
        let node = state.create(path, file)?;
        Ok(Box::new(SimulatedFile {
            disk: self.clone(),
            node,
            locked: false,
        }))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let (mut state, _) = self.step()?;
        state.rename(from, to)
    }

    fn rename_new(&self, from: &Path, to: &Path) -> io::Result<()> {
        let (mut state, _) = self.step()?;
        if state.find(to).is_ok() {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        state.rename(from, to)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        let (mut state, _) = self.step()?;
        let (folder, name) = state.place(path)?;
        match state.lookup(folder, &name)? {
            None => Err(io::ErrorKind::NotFound.into()),
            Some(node) if matches!(state.nodes[node], Node::Dir { .. }) => {
                Err(io::ErrorKind::IsADirectory.into())
            }
            Some(_) => {
                state.change(folder, name, None);
                Ok(())
            }
        }
    }

    fn remove_if_unlocked(&self, path: &Path) -> io::Result<()> {
        let node = self.powered()?.find(path)?;
        if self.powered()?.locked.contains(&node) {
            return Ok(());
        }
        self.remove_file(path)
    }

    fn create_dir(&self, path: &Path) -> io::Result<()> {
        let (mut state, _) = self.step()?;
        state.create(path, Node::dir())?;
        Ok(())
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        let (mut state, fails) = self.step()?;
        let at = state.find(path)?;
        let Node::Dir {
            durable, changes, ..
        } = &mut state.nodes[at]
        else {
            return Err(io::ErrorKind::NotADirectory.into());
        };
        for change in std::mem::take(changes) {
            // What a failed sync should have written, later ones leave out.
            if !fails {
                apply(durable, &change);
            }
        }
        if fails { Err(failed_sync()) } else { Ok(()) }
    }

    fn metadata(&self, path: &Path) -> io::Result<Metadata> {
        let state = self.powered()?;
        let node = state.find(path)?;
        let (is_dir, len) = match &state.nodes[node] {
            Node::File { bytes, .. } => (false, bytes.len() as u64),
            Node::Dir { .. } => (true, 0),
        };
        Ok(Metadata {
            is_dir,
            len,
            modified: None,
        })
    }

    fn folder_id(&self, path: &Path) -> io::Result<Option<FolderId>> {
        let number = self.powered()?.find(path)? as u64;
        Ok(Some(FolderId { device: 0, number }))
    }

    fn read_dir(&self, path: &Path) -> io::Result<Vec<DirEntry>> {
        let state = self.powered()?;
        let node = state.find(path)?;
        let Node::Dir { entries, .. } = &state.nodes[node] else {
            return Err(io::ErrorKind::NotADirectory.into());
        };
        let entry = |(name, node): (&OsString, &usize)| DirEntry {
            name: name.clone(),
            is_dir: matches!(state.nodes[*node], Node::Dir { .. }),
        };
        Ok(entries.iter().map(entry).collect())
    }

    fn read(&self, path: &Path, range: Option<Range<u64>>) -> io::Result<Bytes> {
        let state = self.powered()?;
        let node = state.find(path)?;
        let Node::File { bytes, .. } = &state.nodes[node] else {
            return Err(io::ErrorKind::IsADirectory.into());
        };
        let cut = crate::storage::memory::cut(range, bytes.len() as u64);
        let index = |at| usize::try_from(at).expect("cut to the length, which is a usize");
        Ok(Bytes::copy_from_slice(
            &bytes[index(cut.start)..index(cut.end)],
        ))
    }
}

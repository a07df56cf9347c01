//! A disk in memory, which fills up, stops in the middle of an operation, and forgets in a power
//! cut what was not synced.
//!
//! Changes of names reach the disk in their order, as in a journal. A sync of a directory forces
//! out all changes up to the last one in it, a sync of a file only its content. A power cut keeps
//! any number of the changes of names that were not forced out, and any part of the content.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::{self, Cursor, ErrorKind};
use std::path::Path;
use std::rc::Rc;

use safetensors::SafeTensorError;
use safetensors::tensor::View;
use skein_learner::checkpoint::Storage;

use crate::dice::Dice;

/// Handle of a disk.
#[derive(Debug, Clone, Default)]
pub(crate) struct VirtualDisk(Rc<RefCell<State>>);

#[derive(Debug, Default)]
struct State {
    names: Names,
    /// Names as they are on the disk.
    synced_names: Names,
    /// Changes of names since, in their order.
    journal: Vec<Change>,
    files: Vec<File>,
    /// Operations until the process that does them is dead.
    fuse: Option<u32>,
    /// Operations until the disk is full.
    room: Option<u32>,
}

type Names = BTreeMap<String, Entry>;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Entry {
    Directory,
    File(usize),
}

#[derive(Debug)]
enum Change {
    Create(String, Entry),
    Remove(String),
    Rename(String, String),
}

#[derive(Debug, Clone, Default)]
struct File {
    content: Rc<[u8]>,
    synced: Rc<[u8]>,
}

impl VirtualDisk {
    /// Empties the disk, which has room then.
    pub(crate) fn clear(&self) {
        *self.0.borrow_mut() = State::default();
    }

    /// Lets the process die before the mutating operation after the next `operations` ones. From
    /// then on every operation fails, until [`VirtualDisk::revive`].
    pub(crate) fn arm(&self, operations: u32) {
        self.0.borrow_mut().fuse = Some(operations);
    }

    /// `true` if the process that used the disk has died in an operation.
    pub(crate) fn is_dead(&self) -> bool {
        self.0.borrow().fuse == Some(0)
    }

    /// Lets the next process use the disk.
    pub(crate) fn revive(&self) {
        self.0.borrow_mut().fuse = None;
    }

    /// Lets writes fail for lack of room after so many operations.
    pub(crate) fn fill(&self, operations: u32) {
        self.0.borrow_mut().room = Some(operations);
    }

    /// Makes room.
    pub(crate) fn make_room(&self) {
        self.0.borrow_mut().room = None;
    }

    /// Cuts the power: what was not synced may be lost.
    pub(crate) fn cut_power(&self, dice: &mut Dice) {
        let state = &mut *self.0.borrow_mut();
        let kept = dice.below(state.journal.len() as u64 + 1) as usize;
        for change in state.journal.drain(..).take(kept) {
            apply(&mut state.synced_names, &change);
        }
        state.names = state.synced_names.clone();
        for file in &mut state.files {
            if file.content != file.synced {
                file.content = torn(file, dice);
                file.synced = file.content.clone();
            }
        }
    }

    /// Appends to the file at `path`.
    pub(crate) fn append(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let before = self.open(path, u64::MAX)?.into_inner();
        let state = &mut *self.0.borrow_mut();
        // A full disk takes all or nothing here; production continues behind what was taken.
        state.begin_growth()?;
        state.put(key(path), [&before, bytes].concat().into())
    }

    /// Cuts the file at `path` to its first `bytes` bytes. A missing one is created empty.
    pub(crate) fn truncate(&self, path: &Path, bytes: usize) -> io::Result<()> {
        let content = match self.open(path, u64::MAX) {
            Err(error) if error.kind() == ErrorKind::NotFound => Rc::default(),
            file => file?.into_inner(),
        };
        let state = &mut *self.0.borrow_mut();
        state.begin()?;
        let kept = content.get(..bytes).ok_or(ErrorKind::UnexpectedEof)?;
        state.put(key(path), kept.into())
    }
}

/// Content of an unsynced file after a power cut.
fn torn(file: &File, dice: &mut Dice) -> Rc<[u8]> {
    let common = file
        .content
        .iter()
        .zip(file.synced.iter())
        .take_while(|(now, synced)| now == synced)
        .count();
    match dice.below(3) {
        0 => file.synced.clone(),
        1 => file.content.clone(),
        _ => {
            let more = file.content.len() - common;
            file.content[..common + dice.below(more as u64 + 1) as usize].into()
        }
    }
}

impl State {
    /// Counts an operation that needs no room; fails if the process is dead.
    fn begin(&mut self) -> io::Result<()> {
        if let Some(left) = &mut self.fuse {
            *left = left.saturating_sub(1);
            if *left == 0 {
                return Err(io::Error::other("the process is dead"));
            }
        }
        if let Some(left) = &mut self.room {
            *left = left.saturating_sub(1);
        }
        Ok(())
    }

    /// Counts an operation that needs room; fails also if there is none.
    fn begin_growth(&mut self) -> io::Result<()> {
        self.begin()?;
        match self.room {
            Some(0) => Err(ErrorKind::StorageFull.into()),
            _ => Ok(()),
        }
    }

    fn change(&mut self, change: Change) {
        apply(&mut self.names, &change);
        self.journal.push(change);
    }

    /// Gives the file of this name a content.
    fn put(&mut self, name: &str, content: Rc<[u8]>) -> io::Result<()> {
        match self.names.get(name) {
            Some(Entry::File(file)) => self.files[*file].content = content,
            Some(Entry::Directory) => return Err(ErrorKind::IsADirectory.into()),
            None if !self.names.contains_key(parent(name)) => {
                return Err(ErrorKind::NotFound.into());
            }
            None => {
                let file = File {
                    content,
                    synced: Rc::default(),
                };
                self.files.push(file);
                let entry = Entry::File(self.files.len() - 1);
                self.change(Change::Create(name.to_owned(), entry));
            }
        }
        Ok(())
    }
}

fn apply(names: &mut Names, change: &Change) {
    match change {
        Change::Create(name, entry) => {
            names.insert(name.clone(), *entry);
        }
        Change::Remove(name) => {
            names.remove(name);
        }
        Change::Rename(from, to) => {
            for name in inside(names, from) {
                if let Some(entry) = names.remove(&name) {
                    names.insert(format!("{to}{}", &name[from.len()..]), entry);
                }
            }
        }
    }
}

/// `name`, and everything in it if it is a directory.
fn inside(names: &Names, name: &str) -> Vec<String> {
    let is_inside = |other: &str| {
        other
            .strip_prefix(name)
            .is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
    };
    names
        .range(name.to_owned()..)
        .map(|(other, _)| other)
        .take_while(|other| other.starts_with(name))
        .filter(|other| is_inside(other))
        .cloned()
        .collect()
}

fn key(path: &Path) -> &str {
    path.to_str().unwrap_or_default()
}

fn parent(name: &str) -> &str {
    name.rsplit_once('/').map_or("", |(parent, _)| parent)
}

impl Storage for VirtualDisk {
    type Reader = Cursor<Rc<[u8]>>;

    fn create_directory(&self, path: &Path) -> io::Result<()> {
        let state = &mut *self.0.borrow_mut();
        state.begin_growth()?;
        if !state.names.contains_key(key(path)) {
            state.change(Change::Create(key(path).to_owned(), Entry::Directory));
        }
        Ok(())
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let state = &mut *self.0.borrow_mut();
        let was_dead = state.fuse == Some(0);
        let begun = state.begin_growth();
        // What is cut off in the middle is there in part.
        let written = match begun {
            Ok(()) => bytes,
            Err(_) => &bytes[..bytes.len() / 2],
        };
        if !was_dead {
            state.put(key(path), written.into())?;
        }
        begun
    }

    fn write_tensors<V: View>(
        &self,
        path: &Path,
        tensors: Vec<(String, V)>,
    ) -> Result<(), SafeTensorError> {
        let bytes = safetensors::serialize(tensors, None)?;
        Ok(self.write(path, &bytes)?)
    }

    fn open(&self, path: &Path, _most: u64) -> io::Result<Cursor<Rc<[u8]>>> {
        let state = self.0.borrow();
        match state.names.get(key(path)) {
            Some(Entry::File(file)) => Ok(Cursor::new(state.files[*file].content.clone())),
            Some(Entry::Directory) => Err(ErrorKind::IsADirectory.into()),
            None => Err(ErrorKind::NotFound.into()),
        }
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        let state = &mut *self.0.borrow_mut();
        state.begin()?;
        match state.names.get(key(path)) {
            Some(Entry::File(file)) => {
                let file = &mut state.files[*file];
                file.synced = file.content.clone();
            }
            Some(Entry::Directory) => {
                let is_here = |name: &str| parent(name) == key(path);
                let last = state.journal.iter().rposition(|change| match change {
                    Change::Create(name, _) | Change::Remove(name) => is_here(name),
                    Change::Rename(from, to) => is_here(from) || is_here(to),
                });
                for change in state.journal.drain(..last.map_or(0, |last| last + 1)) {
                    apply(&mut state.synced_names, &change);
                }
            }
            None => return Err(ErrorKind::NotFound.into()),
        }
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let state = &mut *self.0.borrow_mut();
        state.begin()?;
        let (from, to) = (key(from), key(to));
        if !state.names.contains_key(from) {
            return Err(ErrorKind::NotFound.into());
        }
        if state.names.contains_key(to) {
            return Err(ErrorKind::DirectoryNotEmpty.into());
        }
        state.change(Change::Rename(from.to_owned(), to.to_owned()));
        Ok(())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        let state = &mut *self.0.borrow_mut();
        for name in inside(&state.names, key(path)).into_iter().rev() {
            state.begin()?;
            state.change(Change::Remove(name));
        }
        Ok(())
    }

    fn exists(&self, path: &Path) -> bool {
        self.0.borrow().names.contains_key(key(path))
    }

    fn directories(&self, path: &Path) -> io::Result<Vec<OsString>> {
        let state = self.0.borrow();
        let names = inside(&state.names, key(path)).into_iter();
        let is_here = |name: &String| {
            parent(name) == key(path) && state.names.get(name) == Some(&Entry::Directory)
        };
        Ok(names
            .filter(is_here)
            .map(|name| OsString::from(&name[key(path).len() + 1..]))
            .collect())
    }
}

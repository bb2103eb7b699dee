//! Whole files or none, and all files or none.

use crate::error::BakeError;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::SystemTime;

/// New files of a folder, kept apart in a folder within it until all are complete. Dropped unpublished, they
/// are removed, and what the folder held before is as it was.
pub struct Staging {
    folder: PathBuf,
    /// The folder was not there before.
    new: bool,
    apart: PathBuf,
    names: Vec<String>,
}

impl Staging {
    /// Makes the folder where it does not exist yet, and tries whether it can be written to: better known
    /// before hours of work than after.
    ///
    /// # Errors
    /// [`BakeError::Io`] where a folder cannot be made.
    pub fn new(folder: &Path) -> Result<Staging, BakeError> {
        let apart = folder.join(format!(".part-{}", std::process::id()));
        let staging = Staging { folder: folder.into(), new: !folder.exists(), apart, names: Vec::new() };
        staging.make()?;
        // A process that is killed at work leaves nothing in the folder.
        let _ = fs::remove_dir(&staging.apart);
        Ok(staging)
    }

    /// Where to write the file that will be `name` in the folder.
    ///
    /// # Errors
    /// As [`Staging::new`].
    pub fn file(&mut self, name: impl Into<String>) -> Result<PathBuf, BakeError> {
        self.make()?;
        let name = name.into();
        let path = self.apart.join(&name);
        self.names.push(name);
        Ok(path)
    }

    /// Moves the files to their places, in the order in which they were named: who waits for the last of them
    /// finds all. Then removes the files of the folder that are `stale`, of those that were not named.
    ///
    /// # Errors
    /// [`BakeError::Io`] names the file whose place cannot be taken, by a folder of its name for one.
    pub fn publish(self, stale: impl Fn(&str) -> bool) -> Result<(), BakeError> {
        if let Some(path) = self.names.iter().map(|n| self.folder.join(n)).find(|p| p.is_dir()) {
            return Err(BakeError::Io { path, source: std::io::ErrorKind::IsADirectory.into() });
        }
        for name in &self.names {
            let path = self.folder.join(name);
            fs::rename(self.apart.join(name), &path).map_err(|source| BakeError::Io { path, source })?;
        }
        for entry in fs::read_dir(&self.folder).into_iter().flatten().flatten() {
            let named = |name: &str| self.names.iter().any(|n| n == name);
            if entry.file_name().to_str().is_some_and(|name| stale(name) && !named(name)) {
                fs::remove_file(entry.path()).map_err(|source| BakeError::Io { path: entry.path(), source })?;
            }
        }
        Ok(())
    }

    fn make(&self) -> Result<(), BakeError> {
        fs::create_dir_all(&self.apart).map_err(|source| BakeError::Io { path: self.folder.clone(), source })
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.apart);
        if self.new {
            // Fails, as it should, where something was published.
            let _ = fs::remove_dir(&self.folder);
        }
    }
}

/// Writes `bytes` beside `path` and renames, so that `path` never holds half a file and an earlier version
/// survives a failure.
///
/// # Errors
/// [`BakeError::Io`] names the file; nothing is left behind.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), BakeError> {
    replace(path, |file| file.write_all(bytes)).map_err(|source| BakeError::Io { path: path.into(), source })
}

/// In the name of a file that is being written.
pub(super) const PART: &str = ".part-";

/// Puts what `write` writes in the place of `path`, once it is whole; else `path` is as it was, and nothing is left.
pub(super) fn replace(path: &Path, write: impl FnOnce(&mut fs::File) -> io::Result<()>) -> io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(PART);
    name.push(unique());
    let part = path.with_file_name(name);
    let written = fs::File::create_new(&part)
        .and_then(|mut file| write(&mut file).and_then(|()| file.sync_all()))
        .and_then(|()| fs::rename(&part, path));
    if written.is_err() {
        let _ = fs::remove_file(&part);
    }
    written
}

/// What no other call gives, on this machine or others.
pub(super) fn unique() -> String {
    static CALLS: AtomicU64 = AtomicU64::new(0);
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    format!("{}-{}-{}", std::process::id(), since.as_nanos(), CALLS.fetch_add(1, Relaxed))
}

//! Whole files or none.

use crate::error::BakeError;
use std::fs;
use std::io::Write;
use std::path::Path;

/// Writes `bytes` beside `path` and renames, so that `path` never holds half a file and an earlier version
/// survives a failure.
///
/// # Errors
/// [`BakeError::Io`] names the file; nothing is left behind.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), BakeError> {
    let io = |source| BakeError::Io { path: path.into(), source };
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(format!(".part-{}", std::process::id()));
    let part = path.with_file_name(name);
    let written = fs::File::create(&part)
        .and_then(|mut f| f.write_all(bytes).and_then(|()| f.sync_all()))
        .and_then(|()| fs::rename(&part, path));
    written.map_err(|e| {
        let _ = fs::remove_file(&part);
        io(e)
    })
}

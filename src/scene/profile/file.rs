//! Files of profiles.

use crate::scene::ies::MAX_BYTES;
use std::path::Path;

/// The contents of a file of at most [`MAX_BYTES`].
pub(super) fn read_small(path: &Path) -> std::io::Result<Vec<u8>> {
    let found = std::fs::metadata(path)?;
    if !found.is_file() {
        return Err(std::io::Error::other("it is no file; give the .ies file of a luminaire"));
    }
    if found.len() > MAX_BYTES {
        let (have, most) = (found.len() >> 20, MAX_BYTES >> 20);
        return Err(std::io::Error::other(format!("it has {have} MB, more than the {most} of any luminaire's file")));
    }
    std::fs::read(path)
}

/// The contents of the file that a line TILT= names. Files of old name it with folders of their own machine.
pub(super) fn tilt_file(name: &str, folder: Option<&Path>) -> Result<Vec<u8>, String> {
    const CURE: &str = "or write its lines after TILT=INCLUDE, or TILT=NONE if the lamp may tilt";
    let Some(folder) = folder else {
        return Err(format!("a profile inside a scene has no file beside it; write {}", &CURE[3..]));
    };
    let file = name.rsplit(['/', '\\']).next().unwrap_or_default();
    // A letter of a drive would lead out of the folder.
    if matches!(file, "" | "." | "..") || file.contains('\0') || file.as_bytes().get(1) == Some(&b':') {
        return Err(format!("that is no file; name one, {CURE}"));
    }
    let path = folder.join(file);
    read_small(&path).map_err(|e| format!("cannot read {} ({e}); put it there, {CURE}", path.display()))
}

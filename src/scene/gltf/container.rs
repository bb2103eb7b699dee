//! From a file to its JSON and buffers: GLB chunks, data URIs, files beside it.
//!
//! A file referred to by a scene must lie in the scene's folder or below. Links in the file system are
//! followed: they are the doing of whoever set up the folder, not of the scene.

use super::Document;
use super::reader::REPAIR;
use super::unpack::meshopt;
use crate::error::{SceneError, Warning};
use base64::Engine;
use base64::engine::DecodePaddingMode;
use base64::engine::general_purpose::{GeneralPurpose, GeneralPurposeConfig};
use serde_json::Value;
use std::borrow::Cow;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::{Path, PathBuf};

const JSON_CHUNK: u32 = 0x4E4F_534A;
const BIN_CHUNK: u32 = 0x004E_4942;

/// Splits a file's contents into JSON and buffers; `path` says where it is from and where its other files are.
pub(super) fn read(path: &Path, bytes: &[u8]) -> Result<(Document, Vec<Warning>), SceneError> {
    let mut warnings = Vec::new();
    let (json, bin) = if bytes.starts_with(b"glTF") {
        split_glb(bytes, &mut warnings).map_err(|what| invalid(path, what))?
    } else {
        (bytes, None)
    };
    let json = parse_json(json, &mut warnings).map_err(|what| invalid(path, what))?;
    check_version(&json, &mut warnings).map_err(|what| invalid(path, what))?;
    let buffers = read_buffers(path, &json, bin, &mut warnings)?;
    Ok((Document { path: path.into(), json, buffers }, warnings))
}

fn invalid(path: &Path, what: impl Into<String>) -> SceneError {
    SceneError::Invalid { path: path.into(), what: what.into() }
}

/// Contents of a plain file: a folder or a pipe is refused rather than waited for.
pub(super) fn read_file(path: &Path) -> Result<Vec<u8>, SceneError> {
    check_file(path)?;
    fs::read(path).map_err(|source| SceneError::Io { path: path.into(), source })
}

/// A plain file to read from; as [`read_file`].
pub(super) fn open_file(path: &Path) -> Result<BufReader<File>, SceneError> {
    check_file(path)?;
    File::open(path).map(BufReader::new).map_err(|source| SceneError::Io { path: path.into(), source })
}

fn check_file(path: &Path) -> Result<(), SceneError> {
    let metadata = fs::metadata(path).map_err(|source| SceneError::Io { path: path.into(), source })?;
    if metadata.is_file() { Ok(()) } else { Err(invalid(path, "is not a file; give a .glb or .gltf file")) }
}

/// JSON and binary chunk of a GLB file.
fn split_glb<'b>(bytes: &'b [u8], warnings: &mut Vec<Warning>) -> Result<(&'b [u8], Option<&'b [u8]>), String> {
    let word = |at: usize| {
        let four = bytes.get(at..at.checked_add(4)?)?;
        Some(u32::from_le_bytes([four[0], four[1], four[2], four[3]]))
    };
    let (Some(version), Some(length)) = (word(4), word(8)) else {
        return Err("the GLB header is cut off; copy the file again".into());
    };
    if version != 2 {
        return Err(format!("is GLB version {version}, only 2 can be read; convert it to glTF 2.0"));
    }
    let length = length as usize;
    if length > bytes.len() {
        return Err(format!("is cut off: {} of {length} bytes are there; copy the file again", bytes.len()));
    }
    if length < bytes.len() {
        let extra = bytes.len() - length;
        warnings
            .push(Warning::new("glb-trailing-bytes", format!("{extra} bytes after the end of the GLB are ignored")));
    }
    let (mut json, mut bin) = (None, None);
    let mut at = 12;
    while at < length {
        let chunk = word(at).zip(word(at + 4)).and_then(|(size, kind)| {
            let end = (at + 8).checked_add(size as usize)?;
            Some((kind, bytes[..length].get(at + 8..end)?, end))
        });
        let Some((kind, data, end)) = chunk else {
            return Err(format!("the GLB chunk at byte {at} reaches beyond the end of the file; {REPAIR}"));
        };
        match kind {
            JSON_CHUNK if json.is_none() => json = Some(data),
            BIN_CHUNK if bin.is_none() => bin = Some(data),
            _ => {}
        }
        at = end;
    }
    Ok((json.ok_or_else(|| format!("has no JSON chunk; {REPAIR}"))?, bin))
}

fn parse_json(bytes: &[u8], warnings: &mut Vec<Warning>) -> Result<Value, String> {
    let text = match bytes.strip_prefix(b"\xEF\xBB\xBF") {
        Some(rest) => {
            warnings
                .push(Warning::new("byte-order-mark", "the JSON starts with a byte order mark, which glTF forbids"));
            rest
        }
        None => bytes,
    };
    // Some exporters pad the chunk with zeros instead of spaces.
    let end = text.iter().rposition(|&b| b != 0).map_or(0, |i| i + 1);
    let json: Value = serde_json::from_slice(&text[..end])
        .map_err(|e| format!("its JSON cannot be read ({e}); export the file again, or give a .glb or .gltf file"))?;
    if !json.is_object() {
        return Err("is JSON but not glTF; give a .glb or .gltf file".into());
    }
    Ok(json)
}

fn check_version(json: &Value, warnings: &mut Vec<Warning>) -> Result<(), String> {
    let newest = |key| json.get("asset").and_then(|a| a.get(key)).and_then(Value::as_str);
    match newest("minVersion").or(newest("version")) {
        Some(v) if v == "2.0" || newest("minVersion").is_none() && v.starts_with("2.") => Ok(()),
        Some(v) => Err(format!("is glTF {v}, only 2.0 can be read; convert it to glTF 2.0")),
        None => {
            warnings.push(Warning::new("no-asset-version", "the file does not say its glTF version; taken as 2.0"));
            Ok(())
        }
    }
}

fn read_buffers(
    path: &Path,
    json: &Value,
    bin: Option<&[u8]>,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Vec<u8>>, SceneError> {
    let all = match json.get("buffers") {
        None => return Ok(Vec::new()),
        Some(Value::Array(all)) => all,
        Some(_) => return Err(invalid(path, format!("its `buffers` is not an array; {REPAIR}"))),
    };
    let mut buffers = Vec::with_capacity(all.len());
    let placeholders = meshopt::placeholders(json);
    for (i, buffer) in all.iter().enumerate() {
        let label = format!("buffers[{i}]");
        // An exporter may place it first, where the binary chunk would be taken for its data.
        if placeholders[i] {
            buffers.push(Vec::new());
            continue;
        }
        let Some(length) = buffer.get("byteLength").and_then(Value::as_u64) else {
            return Err(invalid(path, format!("{label} has no byteLength; {REPAIR}")));
        };
        let mut data = match (buffer.get("uri"), bin) {
            (Some(Value::String(uri)), _) => read_uri(path, uri, &label)?,
            (Some(_), _) => return Err(invalid(path, format!("{label}: its uri is not a text; {REPAIR}"))),
            (None, Some(bin)) if i == 0 => bin.to_vec(),
            (None, _) => {
                warnings.push(Warning::new("buffer-without-data", format!("{label} has no data in this file")));
                buffers.push(Vec::new());
                continue;
            }
        };
        if (data.len() as u64) < length {
            let have = data.len();
            return Err(invalid(path, format!("{label} is cut off: {have} of {length} bytes are there; {REPAIR}")));
        }
        data.truncate(length as usize);
        buffers.push(data);
    }
    Ok(buffers)
}

/// Bytes of a data URI, or of a file in the folder of `document`. `label` names who refers to it.
///
/// # Errors
/// [`SceneError::Io`] where the file cannot be read, [`SceneError::Invalid`] for everything else.
pub(super) fn read_uri(document: &Path, uri: &str, label: &str) -> Result<Vec<u8>, SceneError> {
    match data_of(uri) {
        Some(data) => data_uri(data).map_err(|what| invalid(document, format!("{label}: {what}; {REPAIR}"))),
        None => read_file(&file_of_uri(document, uri, label)?),
    }
}

/// Whether a URI holds its data itself.
pub(super) fn is_data_uri(uri: &str) -> bool {
    data_of(uri).is_some()
}

/// What follows `data:` in a data URI.
pub(super) fn data_of(uri: &str) -> Option<&str> {
    uri.get(..5).filter(|s| s.eq_ignore_ascii_case("data:")).map(|s| &uri[s.len()..])
}

/// The file in the folder of `document` that a URI means; `label` names who refers to it.
///
/// # Errors
/// [`SceneError::Invalid`] where it is none, or outside of the folder.
pub(super) fn file_of_uri(document: &Path, uri: &str, label: &str) -> Result<PathBuf, SceneError> {
    let folder = document.parent().unwrap_or(Path::new(""));
    let inside = |name: &str| relative_path(name).map_err(|what| invalid(document, format!("{label}: {what}")));
    let decoded = percent_encoding::percent_decode_str(uri)
        .decode_utf8()
        .map_err(|_| invalid(document, format!("{label}: its uri '{uri}' is not UTF-8; rename the file")))?;
    let file = folder.join(inside(&decoded)?);
    // A name that holds a percent sign itself and was not encoded.
    if decoded != uri && !file.exists() {
        let literal = folder.join(inside(uri)?);
        if literal.exists() {
            return Ok(literal);
        }
    }
    Ok(file)
}

/// Contents of a data URI after `data:`.
fn data_uri(rest: &str) -> Result<Vec<u8>, String> {
    let (kind, data) = rest.split_once(',').ok_or("its data URI has no comma")?;
    let mut bytes: Vec<u8> = Cow::from(percent_encoding::percent_decode_str(data)).into_owned();
    if kind.to_ascii_lowercase().ends_with(";base64") {
        bytes.retain(|b| !b.is_ascii_whitespace());
        let lenient = GeneralPurposeConfig::new()
            .with_decode_padding_mode(DecodePaddingMode::Indifferent)
            .with_decode_allow_trailing_bits(true);
        let engine = GeneralPurpose::new(&base64::alphabet::STANDARD, lenient);
        bytes = engine.decode(&bytes).map_err(|e| format!("its data URI is not base64 ({e})"))?;
    }
    Ok(bytes)
}

/// The path of a file below the scene's folder that a decoded URI means.
///
/// # Errors
/// The URI has a scheme, is absolute, leaves the folder, or is no file name.
fn relative_path(uri: &str) -> Result<PathBuf, String> {
    const CURE: &str = "put the file beside the scene and refer to it by its name";
    let scheme = uri.split_once(':').is_some_and(|(s, _)| {
        s.starts_with(|c: char| c.is_ascii_alphabetic())
            && s.chars().all(|c| c.is_ascii_alphanumeric() || "+-.".contains(c))
    });
    // Exporters on Windows write backslashes.
    let parts = uri.split(['/', '\\']);
    if scheme || uri.starts_with(['/', '\\']) {
        return Err(format!("its uri '{uri}' is absolute, which is not allowed; {CURE}"));
    }
    let mut path = PathBuf::new();
    for part in parts {
        match part {
            "" | "." => {}
            ".." => {
                if !path.pop() {
                    return Err(format!("its uri '{uri}' leaves the scene's folder, which is not allowed; {CURE}"));
                }
            }
            // Below a folder as well: where drives have letters, such a part takes the place of all before it.
            drive if drive.as_bytes().get(1) == Some(&b':') => {
                return Err(format!("its uri '{uri}' names a drive, which is not allowed; {CURE}"));
            }
            name => path.push(name),
        }
    }
    if path.as_os_str().is_empty() || uri.contains('\0') {
        return Err(format!("its uri '{uri}' is no file name; {CURE}"));
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uris_stay_in_the_folder() {
        for bad in [
            "/etc/passwd",
            "\\\\host\\share",
            "C:\\a.bin",
            "file:///a.bin",
            "https://x.org/a.bin",
            "../a.bin",
            "a/../../a.bin",
            "..\\a.bin",
            "a/C:/b.bin",
            "a/C:b.bin",
            "a\\C:\\..\\b.bin",
            "",
            ".",
            "a/..",
            "a\0b",
        ] {
            assert!(relative_path(bad).is_err(), "{bad:?} must be refused");
        }
        assert_eq!(relative_path("a b/./c.bin"), Ok(PathBuf::from("a b/c.bin")));
        assert_eq!(relative_path("a\\..\\ c.bin"), Ok(PathBuf::from(" c.bin")));
        assert_eq!(relative_path("12:30.bin"), Ok(PathBuf::from("12:30.bin")));
    }

    #[test]
    fn escaped_parents_are_refused_after_decoding() {
        let refused = read_uri(Path::new("folder/scene.gltf"), "%2e%2e/secret.bin", "buffers[0]");
        assert!(matches!(refused, Err(SceneError::Invalid { .. })), "{refused:?}");
    }

    #[test]
    fn data_uris() {
        assert_eq!(data_uri("application/octet-stream;base64,AQID"), Ok(vec![1, 2, 3]));
        assert_eq!(data_uri(";base64,AQI"), Ok(vec![1, 2]), "padding may be missing");
        assert_eq!(data_uri("text/plain,a%20b"), Ok(b"a b".to_vec()));
        assert!(data_uri(";base64,@@@").is_err());
        assert!(data_uri(";base64").is_err());
    }
}

//! A cache in a folder: a file for each thing that is kept.
//!
//! A file holds sixteen bytes that name the format, the key, the contents, and a hash (BLAKE3) of all before. It appears
//! whole or not at all, and one that is not whole is never used.

use super::files::{PART, replace, unique};
use crate::cache::{Cache, Key, Writing};
use crate::error::{BakeError, Warning};
use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

/// What a file begins with.
const MAGIC: &[u8; 16] = b"evenlight kept 1";

const HASH: usize = blake3::OUT_LEN;
const HEADER: usize = MAGIC.len() + HASH;

/// Unfinished work is kept so often, but for no more than this share of the time.
const KEEP_INTERVAL: Duration = Duration::from_secs(120);
const KEEP_TIME_SHARE: f64 = 0.05;

/// Files that were being written for longer than this were left by a process that was killed.
const STALE: Duration = Duration::from_secs(24 * 3600);

/// Keeps things in a folder, each until newer ones need its place.
#[derive(Debug)]
pub struct CacheFolder {
    folder: PathBuf,
    /// Other builds of this program may compute otherwise.
    build: [u8; HASH],
    most_bytes: u64,
    /// When work was kept last, and how long that took.
    last: (Instant, Duration),
    used: Vec<PathBuf>,
    /// What may be sound, but could not be read now: not to be replaced by less.
    unreadable: Vec<PathBuf>,
    /// Whether light was kept when that was last tried.
    pub keeps_light: bool,
    /// What could not be read or written.
    pub warnings: Vec<Warning>,
}

impl CacheFolder {
    /// The cache in `folder`, made if absent, of at most `most_bytes` once [`trim`](Self::trim) is called.
    ///
    /// # Errors
    /// [`BakeError::Io`] where it cannot be made or read.
    pub fn open(folder: &Path, most_bytes: u64) -> Result<CacheFolder, BakeError> {
        let io = |source| BakeError::Io { path: folder.into(), source };
        fs::create_dir_all(folder).map_err(io)?;
        fs::read_dir(folder).map_err(io)?;
        let mut hasher = blake3::Hasher::new();
        let program = std::env::current_exe().and_then(File::open);
        if program.and_then(|program| hasher.update_reader(program).map(|_| ())).is_err() {
            // What another build kept is not to be found by chance: nothing is.
            hasher.update(unique().as_bytes());
        }
        let build = *hasher.finalize().as_bytes();
        let last = (Instant::now(), Duration::ZERO);
        Ok(CacheFolder {
            folder: folder.into(),
            build,
            most_bytes,
            last,
            used: Vec::new(),
            unreadable: Vec::new(),
            keeps_light: false,
            warnings: Vec::new(),
        })
    }

    /// Removes what was not used for longest until the rest is within the limit. What this bake used stays.
    pub fn trim(&mut self) {
        let entries = fs::read_dir(&self.folder).into_iter().flatten().flatten();
        let all: Vec<(SystemTime, u64, PathBuf)> = entries
            .filter(|entry| entry.file_name().to_str().is_some_and(is_ours))
            .filter_map(|entry| {
                let metadata = entry.metadata().ok()?;
                Some((metadata.modified().ok()?, metadata.len(), entry.path()))
            })
            .collect();
        let (mut files, parts): (Vec<_>, Vec<_>) =
            all.into_iter().partition(|f| f.2.extension() == Some("kept".as_ref()));
        for (modified, _, path) in parts {
            if modified.elapsed().is_ok_and(|age| age > STALE) {
                let _ = fs::remove_file(path);
            }
        }
        files.sort();
        let mut all: u64 = files.iter().map(|f| f.1).sum();
        for (_, size, path) in files.into_iter().filter(|f| !self.used.contains(&f.2)) {
            if all <= self.most_bytes {
                return;
            }
            // Another bake may have been faster.
            if fs::remove_file(path).is_ok() {
                all -= size;
            }
        }
    }

    /// Names this build of the program.
    pub fn build(&self) -> String {
        blake3::Hash::from_bytes(self.build).to_hex()[..32].into()
    }

    fn path(&self, key: &Key) -> PathBuf {
        let hash = blake3::keyed_hash(&self.build, &key.hash).to_hex();
        self.folder.join(format!("{}-{}.kept", key.kind, &hash[..32]))
    }

    fn warn(&mut self, what: String) {
        self.warnings.push(Warning::new("cache", what));
    }
}

/// Writes a file of what `writing` writes.
pub(super) fn write(file: &mut File, key: &Key, writing: &Writing) -> io::Result<()> {
    let mut to = Hashing { to: BufWriter::with_capacity(1 << 20, file), hasher: blake3::Hasher::new() };
    to.write_all(MAGIC)?;
    to.write_all(&key.hash)?;
    writing(&mut to)?;
    let Hashing { mut to, hasher } = to;
    to.write_all(hasher.finalize().as_bytes())?;
    to.flush()
}

/// Whether a file of a cache folder may have this name, or had it while it was written.
pub(super) fn is_ours(name: &str) -> bool {
    let kinds = ["charts-", "density-", "light-", "plan-"];
    kinds.iter().any(|kind| name.starts_with(kind)) && (name.ends_with(".kept") || name.contains(PART))
}

impl Cache for CacheFolder {
    fn load(&mut self, key: &Key) -> Option<Box<dyn Read>> {
        let path = self.path(key);
        match checked(&path, key) {
            Ok(Some(contents)) => {
                self.used.push(path);
                Some(contents)
            }
            Ok(None) => {
                self.warn(format!("{}: damaged, or of another program; it is not used", path.display()));
                None
            }
            Err(e) if e.kind() == io::ErrorKind::NotFound => None,
            Err(e) => {
                self.warn(format!("{}: cannot be read: {e}; it is not used, nor replaced", path.display()));
                self.unreadable.push(path);
                None
            }
        }
    }

    fn keep(&mut self, key: &Key, writing: &Writing) {
        let started = Instant::now();
        let path = self.path(key);
        if self.unreadable.contains(&path) {
            return;
        }
        let written = replace(&path, |file| write(file, key, writing));
        if key.kind == "light" {
            self.keeps_light = written.is_ok();
        }
        if let Err(e) = written {
            let what = format!("{}: cannot be written: {e}; the next bake does that work again", path.display());
            if !self.warnings.iter().any(|w| w.message == what) {
                self.warn(what);
            }
        }
        self.last = (Instant::now(), started.elapsed());
        self.used.push(path);
    }

    fn is_due(&self) -> bool {
        let (at, took) = self.last;
        at.elapsed() > KEEP_INTERVAL.max(took.div_f64(KEEP_TIME_SHARE))
    }
}

/// Whether a file begins as those of a cache do.
pub(super) fn is_kept(path: &Path) -> bool {
    let mut start = [0; MAGIC.len()];
    File::open(path).and_then(|mut file| file.read_exact(&mut start)).is_ok() && start == *MAGIC
}

/// Contents of a file, if it is whole and the key's.
pub(super) fn checked(path: &Path, key: &Key) -> io::Result<Option<Box<dyn Read>>> {
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    let Some(contents) = length.checked_sub((HEADER + HASH) as u64) else { return Ok(None) };
    let mut header = [0; HEADER];
    file.read_exact(&mut header)?;
    if header[..MAGIC.len()] != *MAGIC || header[MAGIC.len()..] != key.hash {
        return Ok(None);
    }
    let mut hasher = blake3::Hasher::new();
    hasher.update(&header);
    hasher.update_reader((&mut file).take(contents))?;
    let mut hash = [0; HASH];
    file.read_exact(&mut hash)?;
    if *hasher.finalize().as_bytes() != hash {
        return Ok(None);
    }
    // What was used last is removed last; a folder that cannot be written to serves as well.
    let _ = File::options().append(true).open(path).and_then(|f| f.set_modified(SystemTime::now()));
    file.seek(SeekFrom::Start(HEADER as u64))?;
    Ok(Some(Box::new(BufReader::with_capacity(1 << 20, file.take(contents)))))
}

/// Hashes what goes through.
struct Hashing<W> {
    to: W,
    hasher: blake3::Hasher,
}

impl<W: Write> Write for Hashing<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = self.to.write(bytes)?;
        self.hasher.update(&bytes[..n]);
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(n: u8) -> Key {
        Key { kind: "light", hash: [n; 32] }
    }

    fn loaded(cache: &mut CacheFolder, key: &Key) -> Option<Vec<u8>> {
        let mut bytes = Vec::new();
        cache.load(key)?.read_to_end(&mut bytes).expect("readable");
        Some(bytes)
    }

    #[test]
    fn what_is_kept_is_found_and_what_is_damaged_is_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut cache = CacheFolder::open(folder.path(), 1 << 20).expect("a cache");
        assert!(cache.load(&key(1)).is_none() && cache.warnings.is_empty());
        cache.keep(&key(1), &|to| to.write_all(b"photons"));
        cache.keep(&key(2), &|to| to.write_all(b""));
        assert_eq!(loaded(&mut cache, &key(1)).as_deref(), Some(&b"photons"[..]));
        assert_eq!(loaded(&mut cache, &key(2)).as_deref(), Some(&b""[..]));
        let path = cache.path(&key(1));
        let whole = fs::read(&path).expect("a file");
        // Every byte counts, and so does every one that is missing.
        for i in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[i] ^= 1;
            fs::write(&path, &damaged).expect("written");
            assert!(cache.load(&key(1)).is_none(), "byte {i}");
            fs::write(&path, &whole[..i]).expect("written");
            assert!(cache.load(&key(1)).is_none(), "{i} bytes");
        }
        assert!(cache.warnings.iter().all(|w| w.message.contains("light-")), "{:?}", cache.warnings);
        // A file of another key under this name, as a copy by hand makes it.
        fs::copy(cache.path(&key(2)), &path).expect("copied");
        assert!(cache.load(&key(1)).is_none());
    }

    #[test]
    fn what_cannot_be_written_leaves_what_was_there() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut cache = CacheFolder::open(folder.path(), 1 << 20).expect("a cache");
        cache.keep(&key(1), &|to| to.write_all(b"photons"));
        cache.keep(&key(1), &|to| {
            to.write_all(b"half")?;
            Err(io::ErrorKind::StorageFull.into())
        });
        assert_eq!(cache.warnings.len(), 1);
        assert_eq!(loaded(&mut cache, &key(1)).as_deref(), Some(&b"photons"[..]));
        assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 1);
    }

    #[test]
    fn the_oldest_give_way() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut cache = CacheFolder::open(folder.path(), 2500).expect("a cache");
        fs::write(folder.path().join("notes.txt"), [0; 4000]).expect("written");
        for n in 1..=4 {
            cache.keep(&key(n), &|to| to.write_all(&[0; 1000]));
            let at = SystemTime::UNIX_EPOCH + Duration::from_secs(n.into());
            File::options().append(true).open(cache.path(&key(n))).and_then(|f| f.set_modified(at)).expect("a time");
        }
        // What a process that was killed left, and one that is at work.
        let parts = ["light-0.part-1", "light-0.part-2"].map(|name| folder.path().join(name));
        parts.iter().for_each(|part| fs::write(part, [0; 10]).expect("written"));
        File::options()
            .append(true)
            .open(&parts[0])
            .and_then(|f| f.set_modified(SystemTime::UNIX_EPOCH))
            .expect("a time");
        cache.used.clear();
        assert!(cache.load(&key(1)).is_some());
        cache.trim();
        let left: Vec<bool> = (1..=4).map(|n| cache.path(&key(n)).exists()).collect();
        assert_eq!(left, [true, false, false, true]);
        assert!(folder.path().join("notes.txt").exists());
        assert_eq!(parts.map(|part| part.exists()), [false, true]);
    }
}

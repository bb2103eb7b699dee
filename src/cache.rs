//! What of a bake another may use: by content, so that nothing stale is ever found.
//!
//! Charts are named by the meshes they were cut from, and light by all that it depends on, but not by the targets and
//! limits that only say when to stop: a bake with a lower target, or one that was killed, goes on where the last one
//! was. What is kept is the work as it stood, so that it makes no difference to the result whether it was interrupted.

use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fmt;
use std::io::{self, Read, Write};

/// Raised whenever the meaning of anything that is kept, or what is computed from it, changes.
const VERSION: u32 = 2;

/// The name of something that is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Key {
    /// What it is: `charts`, `density`, `light` or `plan`.
    pub kind: &'static str,
    /// Hash (BLAKE3) of all that it depends on.
    pub hash: [u8; 32],
}

/// `kind-` and the first half of the hash in hexadecimal digits: 128 bits are enough to tell all of them apart.
impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}-", self.kind)?;
        self.hash[..16].iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// Collects what something depends on. Text comes in through [`fmt::Write`].
#[derive(Debug, Clone)]
pub struct Digest(blake3::Hasher);

impl Default for Digest {
    fn default() -> Digest {
        let mut digest = Digest(blake3::Hasher::new());
        digest.bytes(env!("CARGO_PKG_VERSION").as_bytes());
        digest.bytes(&VERSION.to_le_bytes());
        digest
    }
}

impl Digest {
    /// Adds `bytes`; where they end counts.
    pub fn bytes(&mut self, bytes: &[u8]) {
        self.0.update(&(bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
    }

    /// Adds plain values, bit by bit.
    pub fn values<T: bytemuck::NoUninit>(&mut self, values: &[T]) {
        self.bytes(bytemuck::cast_slice(values));
    }

    /// Adds `value` as it is written for debugging, which tells all numbers apart.
    pub fn debug(&mut self, value: &dyn fmt::Debug) {
        // Cannot fail: nothing here does.
        let _ = fmt::write(self, format_args!("{value:?};"));
    }

    /// The key of a `kind`.
    pub fn key(&self, kind: &'static str) -> Key {
        let mut all = self.0.clone();
        all.update(kind.as_bytes());
        Key { kind, hash: *all.finalize().as_bytes() }
    }
}

impl fmt::Write for Digest {
    fn write_str(&mut self, s: &str) -> fmt::Result {
        self.0.update(s.as_bytes());
        Ok(())
    }
}

/// Writes what is to be kept.
pub type Writing<'w> = dyn Fn(&mut dyn Write) -> io::Result<()> + 'w;

/// Keeps things by name.
pub trait Cache: Send + Sync {
    /// Whole contents of what was kept under `key`; `None` where nothing sound was.
    fn load(&mut self, key: &Key) -> Option<Box<dyn Read>>;

    /// Keeps what `writing` writes under `key`, in the place of what was there. Where that fails, a bake goes on without.
    fn keep(&mut self, key: &Key, writing: &Writing);

    /// Whether unfinished work should be kept now. Asked often.
    fn is_due(&self) -> bool;

    /// Whether it is of one bake on several machines, which have to find the same whatever chance had a part in.
    fn is_plan(&self) -> bool {
        false
    }
}

/// A cache, and what all that a bake keeps there depends on.
pub struct Keeping<'c> {
    /// Where it is.
    pub cache: &'c mut dyn Cache,
    /// What all depends on.
    pub digest: Digest,
}

impl Keeping<'_> {
    /// The place of a `kind`, of the `part` of a bake.
    pub fn slot(&mut self, kind: &'static str, part: &dyn fmt::Debug) -> Slot<'_> {
        let mut digest = self.digest.clone();
        digest.debug(part);
        Slot { cache: &mut *self.cache, key: digest.key(kind) }
    }
}

/// A place in a cache.
pub struct Slot<'c> {
    /// Where it is.
    pub cache: &'c mut dyn Cache,
    /// Its name.
    pub key: Key,
}

impl fmt::Debug for Keeping<'_> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Keeping").field("digest", &self.digest).finish_non_exhaustive()
    }
}

impl fmt::Debug for Slot<'_> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Slot").field("key", &self.key).finish_non_exhaustive()
    }
}

/// Bytes of the longest string of anything that is kept.
const LONGEST_STRING: usize = 1 << 16;

impl Slot<'_> {
    /// What it holds; `None` where that is nothing, or something else.
    pub fn load<T: DeserializeOwned>(&mut self) -> Option<T> {
        read_value(&mut *self.cache.load(&self.key)?)
    }

    /// Keeps `value`.
    pub fn keep<T: Serialize>(&mut self, value: &T) {
        self.cache.keep(&self.key, &|to| write_value(to, value));
    }
}

/// Writes `value`, one after another where there are several.
pub(crate) fn write_value<T: Serialize>(to: &mut dyn Write, value: &T) -> io::Result<()> {
    let mut to = Telling { to, fault: None };
    let written = postcard::to_io(value, &mut to).map(|_| ());
    written.map_err(|e| to.fault.take().unwrap_or_else(|| io::Error::other(e)))
}

/// The next value of what [`write_value`] wrote; `None` where that is something else.
pub(crate) fn read_value<T: DeserializeOwned>(from: &mut dyn Read) -> Option<T> {
    let mut scratch = vec![0; LONGEST_STRING];
    let (value, _) = postcard::from_io((from, &mut scratch)).ok()?;
    Some(value)
}

/// Remembers why nothing could be written: who serialises says only that it was so.
struct Telling<'w> {
    to: &'w mut dyn Write,
    fault: Option<io::Error>,
}

impl Write for Telling<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self.to.write_all(bytes) {
            Ok(()) => Ok(bytes.len()),
            Err(e) => {
                let kind = e.kind();
                self.fault = Some(e);
                Err(kind.into())
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Full;

    impl Cache for Full {
        fn load(&mut self, _key: &Key) -> Option<Box<dyn Read>> {
            None
        }

        fn keep(&mut self, _key: &Key, writing: &Writing) {
            let mut room = [0u8; 4];
            let fault = writing(&mut io::Cursor::new(&mut room[..])).expect_err("no room for it");
            assert_eq!(fault.kind(), io::ErrorKind::WriteZero);
        }

        fn is_due(&self) -> bool {
            true
        }
    }

    #[test]
    fn why_nothing_can_be_written_is_told() {
        let key = Digest::default().key("light");
        Slot { cache: &mut Full, key }.keep(&vec![1u64 << 60; 100]);
    }

    #[test]
    fn what_differs_has_another_name() {
        let name = |feed: &dyn Fn(&mut Digest)| {
            let mut digest = Digest::default();
            feed(&mut digest);
            digest.key("light").to_string()
        };
        let names = [
            name(&|_| ()),
            name(&|d| d.bytes(b"ab")),
            name(&|d| {
                d.bytes(b"a");
                d.bytes(b"b");
            }),
            name(&|d| d.values(&[0.0f32])),
            name(&|d| d.values(&[-0.0f32])),
            name(&|d| d.debug(&0.1f32)),
            name(&|d| d.debug(&0.1f64.next_up())),
        ];
        assert_eq!(names.iter().collect::<std::collections::BTreeSet<_>>().len(), names.len());
        assert!(names[0].starts_with("light-") && names[0].len() == 6 + 32, "{}", names[0]);
        let digest = Digest::default();
        assert_ne!(digest.key("light").hash, digest.key("charts").hash);
    }
}

//! A plan in a folder, and what shards did in files.
//!
//! The folder holds `plan.json`, which says what is baked and how, and what is kept of the light so far as a cache does.
//! The file of a shard names the plan that it is of; it appears whole or not at all, and one that is not whole is refused.

use super::cache_folder::{CacheFolder, checked, is_kept, is_ours, write};
use super::files::{replace, unique, write_atomically};
use super::lightmap_exr::Layer;
use crate::cache::{Cache, Key, Writing, read_value, write_value};
use crate::error::BakeError;
use crate::options::{BakeOptions, SkySource};
use crate::scene::Changes;
use crate::solve::{PlanOutlook, Shard, ShardWork, Shards};
use serde::{Deserialize, Serialize};
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Name of the file that says what a plan is of.
const PLAN: &str = "plan.json";

/// What is baked, and how.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PlanInputs {
    /// The scene's file.
    pub scene: PathBuf,
    /// Variant of its materials.
    pub variant: Option<String>,
    /// Changes to it.
    pub changes: Changes,
    /// How it is baked.
    pub options: BakeOptions,
    /// Maps are 32-bit float.
    pub float: bool,
    /// More layers of the maps.
    pub layers: Vec<Layer>,
    /// Lights that are baked leave the scene.
    pub remove_baked_lights: bool,
}

impl PlanInputs {
    /// The same with whole paths, so that they hold from any folder.
    ///
    /// # Errors
    /// [`BakeError::Options`] where the folder of this process is gone.
    pub fn with_whole_paths(mut self) -> Result<PlanInputs, BakeError> {
        let whole = |path: &mut PathBuf| -> Result<(), BakeError> {
            let found = std::path::absolute(&path);
            *path = found.map_err(|e| BakeError::Options(format!("{}: has no whole path: {e}", path.display())))?;
            Ok(())
        };
        whole(&mut self.scene)?;
        self.changes.lights.iter_mut().filter_map(|(_, change)| change.ies.as_mut()).try_for_each(whole)?;
        if let Some(SkySource::File(path)) = &mut self.options.sky {
            whole(path)?;
        }
        Ok(self)
    }
}

/// `plan.json`.
#[derive(Debug, Serialize, Deserialize)]
struct PlanFile {
    /// Version of the program.
    evenlight: String,
    /// Its build: others may compute otherwise.
    build: String,
    /// What is left to do, by group of lights.
    outlook: Vec<PlanOutlook>,
    /// What it is of.
    inputs: PlanInputs,
}

/// A plan in a folder.
#[derive(Debug)]
pub struct PlanFolder {
    folder: PathBuf,
    cache: CacheFolder,
    /// It is being made.
    open: bool,
    /// It was not there before.
    new: bool,
    /// Why something could not be kept.
    fault: Option<String>,
}

impl PlanFolder {
    /// A folder for a new plan, made if absent. It is to be empty, but for what a killed process left of a plan.
    ///
    /// # Errors
    /// [`BakeError::Io`] where it cannot be made; [`BakeError::Plan`] where it holds anything.
    pub fn create(folder: &Path) -> Result<PlanFolder, BakeError> {
        let new = !folder.exists();
        let entries = fs::read_dir(folder).into_iter().flatten().flatten();
        if entries.map(|entry| entry.file_name()).any(|name| !name.to_str().is_some_and(is_ours)) {
            let what = format!("{}: holds something already; remove that, or name a new folder", folder.display());
            return Err(BakeError::Plan(what));
        }
        let cache = CacheFolder::open(folder, u64::MAX)?;
        Ok(PlanFolder { folder: folder.into(), cache, open: true, new, fault: None })
    }

    /// Completes a new plan.
    ///
    /// # Errors
    /// [`BakeError`] where it cannot be written whole.
    pub fn finish(&mut self, inputs: PlanInputs, outlook: Vec<PlanOutlook>) -> Result<(), BakeError> {
        if let Some(fault) = self.fault.take() {
            return Err(BakeError::Plan(fault));
        }
        let path = self.folder.join(PLAN);
        let plan = PlanFile { evenlight: env!("CARGO_PKG_VERSION").into(), build: self.cache.build(), outlook, inputs };
        let text = serde_json::to_string_pretty(&plan);
        let text = text.map_err(|e| BakeError::Io { path: path.clone(), source: io::Error::other(e) })?;
        write_atomically(&path, (text + "\n").as_bytes())?;
        self.open = false;
        Ok(())
    }

    /// A plan that is there, and what it is of.
    ///
    /// # Errors
    /// [`BakeError::Plan`] where there is none, or one of another build of this program.
    pub fn open(folder: &Path) -> Result<(PlanFolder, PlanInputs), BakeError> {
        let path = folder.join(PLAN);
        let fail = |why: String| BakeError::Plan(format!("{}: {why}", path.display()));
        let text = fs::read_to_string(&path).map_err(|e| fail(format!("cannot be read: {e}; is this a plan?")))?;
        let plan: PlanFile = serde_json::from_str(&text).map_err(|e| fail(format!("is no plan: {e}")))?;
        let cache = CacheFolder::open(folder, u64::MAX)?;
        if plan.build != cache.build() {
            return Err(fail(format!(
                "was made by another build of evenlight ({}); use that, or make the plan anew",
                plan.evenlight
            )));
        }
        let folder = PlanFolder { folder: folder.into(), cache, open: false, new: false, fault: None };
        Ok((folder, plan.inputs))
    }

    /// The name of what shards of this plan did: of what the plan holds.
    fn key(&self) -> Result<Key, BakeError> {
        let mut hasher = blake3::Hasher::new();
        for path in kept(&self.folder)? {
            let mut end = [0; blake3::OUT_LEN];
            let read = File::open(&path).and_then(|mut file| {
                file.seek(SeekFrom::End(-(end.len() as i64))).and_then(|_| file.read_exact(&mut end))
            });
            read.map_err(|e| BakeError::Plan(format!("{}: cannot be read: {e}", path.display())))?;
            hasher.update(name(&path).as_bytes());
            hasher.update(&end);
        }
        Ok(Key { kind: "shard", hash: *hasher.finalize().as_bytes() })
    }

    /// `error`, or what is wrong with the files of the plan where it comes from that.
    pub fn explain(&self, error: BakeError) -> BakeError {
        match (&error, self.cache.warnings.first()) {
            (BakeError::Plan(_), Some(warning)) => BakeError::Plan(warning.message.clone()),
            (BakeError::Plan(what), None) => BakeError::Plan(format!("{}: {what}", self.folder.display())),
            _ => error,
        }
    }

    /// Tries whether a shard can be written to `path`: better known before hours of work than after.
    ///
    /// # Errors
    /// [`BakeError::Io`] where it cannot, [`BakeError::Plan`] where that is the file of something else.
    pub fn try_shard(path: &Path) -> Result<(), BakeError> {
        let other = fs::metadata(path).is_ok() && !is_kept(path);
        if other {
            let what =
                format!("{}: is something else than a shard, and not replaced; name another file", path.display());
            return Err(BakeError::Plan(what));
        }
        let beside = path.with_extension(unique());
        let tried = File::create_new(&beside).and_then(|_| fs::remove_file(&beside));
        tried.map_err(|source| BakeError::Io { path: path.into(), source })
    }

    /// Writes what `shard` did.
    ///
    /// # Errors
    /// [`BakeError::Io`]; nothing is left behind.
    pub fn write_shard(&self, path: &Path, shard: Shard, work: &[ShardWork]) -> Result<(), BakeError> {
        let key = self.key()?;
        let writing: &Writing = &|to| {
            write_value(to, &shard)?;
            write_value(to, &work)
        };
        replace(path, |file| write(file, &key, writing)).map_err(|source| BakeError::Io { path: path.into(), source })
    }

    /// The shards in `files`.
    ///
    /// # Errors
    /// [`BakeError::Plan`] names one that is damaged, of another plan, or one of another number of shards.
    pub fn shards(&self, files: &[PathBuf]) -> Result<ShardFiles, BakeError> {
        let key = self.key()?;
        let mut found: Vec<(PathBuf, Shard)> = Vec::new();
        let mut twice = Vec::new();
        for path in files {
            let shard: Shard = read_value(&mut *contents(path, &key)?).ok_or_else(|| damaged(path))?;
            if let Some((other, first)) = found.first().filter(|(_, first)| first.count != shard.count) {
                let (path, other) = (path.display(), other.display());
                let what = format!("{path}: is one of {} shards, and {other} one of {}", shard.count, first.count);
                return Err(BakeError::Plan(what + "; merge shards of one number"));
            }
            match found.iter().find(|(_, s)| *s == shard) {
                Some(_) => twice.push(path.clone()),
                None => found.push((path.clone(), shard)),
            }
        }
        found.sort_by_key(|(_, shard)| shard.number);
        Ok(ShardFiles { key, files: found, twice })
    }
}

/// A new plan that was not completed leaves nothing.
impl Drop for PlanFolder {
    fn drop(&mut self) {
        if self.open && self.new {
            let _ = fs::remove_dir_all(&self.folder);
        }
    }
}

impl Cache for PlanFolder {
    fn load(&mut self, key: &Key) -> Option<Box<dyn Read>> {
        self.cache.load(key)
    }

    fn keep(&mut self, key: &Key, writing: &Writing) {
        if self.open {
            let before = self.cache.warnings.len();
            self.cache.keep(key, writing);
            let fault = self.cache.warnings.get(before).map(|w| w.message.clone());
            self.fault = self.fault.take().or(fault);
        }
    }

    fn is_plan(&self) -> bool {
        true
    }

    fn is_due(&self) -> bool {
        false
    }
}

/// What shards did, in files.
#[derive(Debug)]
pub struct ShardFiles {
    key: Key,
    files: Vec<(PathBuf, Shard)>,
    /// Files of shards that another one was of: they count once.
    pub twice: Vec<PathBuf>,
}

impl ShardFiles {
    /// How many shards there are to be, and how many of them are missing.
    pub fn count(&self) -> (u32, u32) {
        let count = self.files.first().map_or(0, |(_, shard)| shard.count);
        (count, count - self.files.len() as u32)
    }

    /// Numbers of those that are missing.
    pub fn missing(&self) -> impl Iterator<Item = u32> {
        let has = |number: &u32| self.files.binary_search_by_key(number, |(_, s)| s.number).is_ok();
        (1..=self.count().0).filter(move |number| !has(number))
    }
}

impl Shards for ShardFiles {
    fn visit(&self, part: usize, take: &mut dyn FnMut(&ShardWork) -> Result<(), BakeError>) -> Result<(), BakeError> {
        for (path, _) in &self.files {
            let mut from = contents(path, &self.key)?;
            let work = read_value::<Shard>(&mut *from).and_then(|_| read_value::<Vec<ShardWork>>(&mut *from));
            let work = work.ok_or_else(|| damaged(path))?;
            take(work.get(part).ok_or_else(|| damaged(path))?)?;
        }
        Ok(())
    }

    fn are_complete(&self) -> bool {
        self.count().1 == 0
    }
}

fn contents(path: &Path, key: &Key) -> Result<Box<dyn Read>, BakeError> {
    match checked(path, key) {
        Ok(Some(contents)) => Ok(contents),
        Ok(None) => Err(damaged(path)),
        Err(e) => Err(BakeError::Plan(format!("{}: cannot be read: {e}", path.display()))),
    }
}

fn damaged(path: &Path) -> BakeError {
    BakeError::Plan(format!(
        "{}: is damaged, or no shard of this plan; run that shard again, or leave it out",
        path.display()
    ))
}

/// What a folder keeps, in order of names.
fn kept(folder: &Path) -> Result<Vec<PathBuf>, BakeError> {
    let entries = fs::read_dir(folder).map_err(|source| BakeError::Io { path: folder.into(), source })?;
    let paths = entries.flatten().map(|entry| entry.path());
    let mut all: Vec<PathBuf> = paths.filter(|path| path.extension() == Some("kept".as_ref())).collect();
    all.sort();
    Ok(all)
}

fn name(path: &Path) -> &str {
    path.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

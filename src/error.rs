//! What can go wrong, and what is odd but usable.

use std::path::PathBuf;

/// Why a scene cannot be loaded. Every message names the file's object and the cure.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// A file cannot be read.
    #[error("cannot read {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is not what it says it is.
    #[error("{path}: {what}")]
    Invalid {
        /// The file.
        path: PathBuf,
        /// Object, fault and cure in one sentence.
        what: String,
    },
    /// The file needs an extension that is not supported.
    #[error("{path}: needs the extension {extension}, which evenlight does not support; {cure}")]
    Extension {
        /// The file.
        path: PathBuf,
        /// Name of the extension.
        extension: String,
        /// How to get rid of it.
        cure: String,
    },
}

/// Why a bake ends without a result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BakeError {
    /// The scene cannot be loaded.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// An option is out of range or contradicts another.
    #[error("{0}")]
    Options(String),
    /// The scene holds nothing that could be baked.
    #[error("{0}")]
    Nothing(String),
    /// The lightmap UVs of the file cannot be used.
    #[error("{0}")]
    Uv(String),
    /// More memory or texels than allowed.
    #[error("{what} would take {asked}, more than the {allowed} allowed; {cure}")]
    Limit {
        /// What was asked for.
        what: &'static str,
        /// How much.
        asked: String,
        /// The limit.
        allowed: String,
        /// How to get under it.
        cure: String,
    },
    /// A plan or a shard cannot be used.
    #[error("{0}")]
    Plan(String),
    /// The observer asked to stop.
    #[error("cancelled")]
    Cancelled,
    /// A result cannot be written.
    #[error("cannot write {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// Something odd but usable: the bake goes on and the report lists it.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Warning {
    /// Stable short name to filter by, for instance `image-not-decoded`.
    pub code: &'static str,
    /// Object and consequence in one sentence.
    pub message: String,
}

impl Warning {
    /// A warning with a stable `code` and a sentence that names the object.
    pub fn new(code: &'static str, message: impl Into<String>) -> Warning {
        Warning { code, message: message.into() }
    }
}

//! Addresses of object storage, and the option that goes with them.

use std::path::{Path, PathBuf};

/// The place of local copies.
#[derive(Debug, clap::Args)]
pub(crate) struct StorageArgs {
    /// Folder for local copies of s3://BUCKET/FOLDER addresses [default: splat4d in the user's cache folder]
    #[arg(long, value_name = "FOLDER")]
    local: Option<PathBuf>,
}

/// Whether a path is an address of object storage.
pub(crate) fn is_address(path: &Path) -> bool {
    path.to_str().is_some_and(|text| text.starts_with("s3://"))
}

/// Errors: this build has no object storage.
#[cfg(not(feature = "storage"))]
pub(crate) fn refused<T>() -> anyhow::Result<T> {
    let what = "object storage (s3://) is left out of this build of splat4d";
    Err(splat4d::Error::new(splat4d::ErrorKind::Unsupported, what)
        .remedy("Use a release archive, or build it: cargo install splat4d --features storage")
        .into())
}

#[cfg(feature = "storage")]
impl StorageArgs {
    /// The storage that the environment names, as programs of AWS do.
    pub(crate) fn open(&self) -> splat4d_workflow::storage::Storage {
        use splat4d_workflow::storage::{Access, Storage};
        let read = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        let access = Access {
            key: read("AWS_ACCESS_KEY_ID"),
            secret: read("AWS_SECRET_ACCESS_KEY"),
            token: read("AWS_SESSION_TOKEN"),
            region: read("AWS_REGION").or_else(|| read("AWS_DEFAULT_REGION")),
            endpoint: read("AWS_ENDPOINT_URL_S3").or_else(|| read("AWS_ENDPOINT_URL")),
            certificates: read("AWS_CA_BUNDLE").map(PathBuf::from),
        };
        let cache = || {
            let home = |name: &str, below: &str| read(name).map(|path| Path::new(&path).join(below));
            home("XDG_CACHE_HOME", "splat4d")
                .or_else(|| home("LOCALAPPDATA", "splat4d"))
                .or_else(|| home("HOME", ".cache/splat4d"))
                .unwrap_or_else(|| std::env::temp_dir().join("splat4d"))
        };
        Storage::s3(self.local.clone().unwrap_or_else(cache), access)
    }
}

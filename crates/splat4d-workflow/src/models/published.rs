//! Descriptions of published exports. None was run with its real weights: names, sizes and constants are those of the
//! programs that are published with the exports.

use crate::files::either;
use splat4d::{Error, Result};

/// Names and texts of the descriptions.
pub const PUBLISHED: [(&str, &str); 10] = [
    ("depth-anything-v2", include_str!("published/depth-anything-v2.toml")),
    ("depth-anything-v2-hf", include_str!("published/depth-anything-v2-hf.toml")),
    ("midas-v2", include_str!("published/midas-v2.toml")),
    ("raft", include_str!("published/raft.toml")),
    ("superpoint-lightglue", include_str!("published/superpoint-lightglue.toml")),
    ("efficient-loftr", include_str!("published/efficient-loftr.toml")),
    ("roma-v2", include_str!("published/roma-v2.toml")),
    ("rtmo", include_str!("published/rtmo.toml")),
    ("pphumanseg", include_str!("published/pphumanseg.toml")),
    ("u2net-human-seg", include_str!("published/u2net-human-seg.toml")),
];

/// The text of a description. Errors: another name.
pub fn published(name: &str) -> Result<&'static str> {
    let names = PUBLISHED.map(|(known, _)| known);
    PUBLISHED.iter().find(|(known, _)| *known == name).map(|(_, text)| *text).ok_or_else(|| {
        Error::input(format!("unknown description \"{name:.60}\": expected {}", either(&names)))
            .remedy("Or write model.toml next to the network (docs/networks.md)")
    })
}

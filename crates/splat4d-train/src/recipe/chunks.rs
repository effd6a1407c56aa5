//! The settings of long captures in chunks.

use crate::settings::settings;

settings! {
    /// Long captures in chunks.
    #[derive(Copy)]
    pub struct ChunkSettings {
        /// Frames per chunk; longer captures train chunk by chunk. 0: 60 if fixed cameras have more than 300 frames and
        /// the recipe supports chunks, otherwise no chunks. Iterations are those of a chunk.
        frames: usize = 0 => any().unit("frames");
        /// Frames that neighbouring chunks share and in which they cross-fade; an even number.
        overlap: usize = 16 => any().unit("frames");
        /// Weight of the difference (L1) between an odd chunk's renders and its neighbours' in the overlap.
        consistency: f64 = 2.0;
    }
}

//! Layers of pages as a reader decodes them, without a file: for training against the numbers that will be rendered
//! (straight-through quantisation).

use super::block::Words;
use super::layer::{TABLES, columns, decode, keys, paint};
use super::page::Header;
use super::{BLOCK_GAUSSIANS, Depths, PAGE_WORDS, Palette};
use crate::layers::Layer;
use crate::scene::table::{TableMut, par_split};
use crate::scene::{BLOCK, Key, SH, Table};
use crate::simd::{Kernel, Simd, dispatch};

/// Encodes and decodes layers that are pages, exactly as the writer and the reader do.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Coder {
    /// Bits of the codes; must pass [`Depths::check`].
    pub depths: Depths,
}

impl Coder {
    /// Writes into `shown` what a reader would see of `layer`, a page whose rows are in the file's order: of the blocks
    /// of 256 rows for which `wanted` holds; other rows are not changed. A block's ranges are those of all its rows.
    /// Above degree 0 colours are those of the palette's entries `labels`; without a palette they stay, and `labels`
    /// may be empty.
    ///
    /// Parallel over blocks; the same bits for any number of threads. Panics: a layer that is none that a page gives,
    /// another shape of `shown`, a label beyond the palette, depths out of range.
    pub fn show(
        &self,
        layer: &Layer<f32>,
        labels: &[u16],
        palette: Option<&Palette>,
        wanted: &(dyn Fn(usize) -> bool + Sync),
        shown: &mut Layer<f32>,
    ) {
        let (keys, rows) = (keys(layer), layer.params.len());
        assert!(self.depths.check().is_ok(), "depths are checked where they are given: {:?}", self.depths);
        assert!(shown.params.len() == rows, "{} shown rows of {rows}", shown.params.len());
        assert!(palette.is_none() || labels.len() == rows, "{} labels of {rows} rows", labels.len());
        let width = palette.map_or(0, Palette::width);
        assert!(shown.params[SH].width() >= 3 + width, "room for {width} coefficients above degree 0");
        let tables = shown.params.get_mut(keys).map(Table::view_mut);
        // Runs of table blocks begin where blocks of the file begin: 1024 rows are four of them.
        par_split(tables, &|mut views| {
            let [first, end] = [views[0].first, views[0].first + views[0].rows];
            assert!(first.is_multiple_of(BLOCK_GAUSSIANS), "a task begins with a block");
            for from in (first..end).step_by(BLOCK_GAUSSIANS) {
                if !wanted(from / BLOCK_GAUSSIANS) {
                    continue;
                }
                let count = BLOCK_GAUSSIANS.min(end - from);
                let labels = if palette.is_some() { &labels[from..from + count] } else { &[] };
                let depths = &self.depths;
                let tables = &mut views;
                dispatch(
                    Simd::detect(),
                    Show { source: Rows { layer, keys, labels, first: from, count }, depths, tables },
                );
                paint(labels, palette, from, &mut views[1]);
            }
            0.0
        });
    }
}

/// A run of rows of a page's layer, at most a block.
#[derive(Clone, Copy)]
pub(super) struct Rows<'a> {
    pub layer: &'a Layer<f32>,
    pub keys: [Key; TABLES],
    /// Of these rows; or none.
    pub labels: &'a [u16],
    pub first: usize,
    pub count: usize,
}

/// Rows as a block of the file.
pub(super) struct Encode<'a> {
    pub source: Rows<'a>,
    pub depths: &'a Depths,
    /// Zero before.
    pub words: &'a mut Words,
}

impl Kernel for Encode<'_> {
    type Out = Header;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> Header {
        let Rows { layer, keys, labels, first, count } = self.source;
        columns(layer, keys, labels, first, count).encode(layer.span, self.depths, self.words)
    }
}

/// Rows encoded and decoded.
struct Show<'a, 'b> {
    source: Rows<'a>,
    depths: &'a Depths,
    tables: &'a mut [TableMut<'b, f32>; TABLES],
}

impl Kernel for Show<'_, '_> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let mut words = [[0; BLOCK_GAUSSIANS]; PAGE_WORDS];
        let Rows { layer, first, count, .. } = self.source;
        let header = Encode { source: self.source, depths: self.depths, words: &mut words }.run::<FMA>();
        decode(&header, &words, layer.span, first..first + count, self.tables);
    }
}

const _: () = assert!(BLOCK_GAUSSIANS.is_multiple_of(BLOCK));

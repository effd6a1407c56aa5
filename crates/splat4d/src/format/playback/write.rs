//! Writes a playback file: tiers, order, palette, pages, and the index before them.

use super::block::encode_page;
use super::cluster::cluster;
use super::deflate::deflate;
use super::index::{MASK_HEAD, crc, mask_keys};
use super::ladder::{FIRST_GAUSSIANS, Ladder, Next, Tier};
use super::page::parse_page;
use super::{
    BLOCK_GAUSSIANS, BLOCK_HEADER, Codec, Depths, Draft, Entry, FIRST_VERSION, Index, Kind, MAX_PAGE_GAUSSIANS,
    MAX_PALETTE, Meta, Node, Page, Palette, Rung, features, labels, ladder, mask, order,
};
use crate::math::{Rng, quat, sh};
use crate::scene::KeyMasks;
use crate::{Error, Result};
use std::io::Write;

/// Gaussians an entry of the palette: an entry costs 45 bytes, so that it adds under 4 bytes to each of its Gaussians.
const GAUSSIANS_PER_ENTRY: usize = 12;
/// A palette may always have this many entries: 11 kB.
const SMALL_PALETTE: usize = 256;
/// Share of a node's Gaussians in its first tier, and the fewest for a page of its own. Ranked by what images lack, so
/// many show the bundled scene at 28 dB, its dynamic regions at 29 dB; a quarter shows it at 22 and 23 dB.
const FIRST_TIER: f64 = 0.4;
const SMALLEST_TIER: usize = 4096;
/// The program that writes, as files name it.
pub(super) const GENERATOR: &str = concat!("splat4d ", env!("CARGO_PKG_VERSION"));
/// Bytes of a palette's ranges, before its planes.
const RANGE_BYTES: usize = 12;
/// A poster up to this size is placed before everything else; a larger one would only delay the first image.
const SMALL_POSTER: usize = 64 << 10;
/// The palette takes a Gaussian's importance for at least and at most this many times the mean.
const WEIGHTS: [f32; 2] = [0.01, 100.0];

/// Options of the writer.
#[derive(Clone, Debug, PartialEq)]
pub struct WriteConfig {
    /// Most entries of the palette, at most 65,536. There are never more than one for 12 Gaussians (or 256 in all).
    pub palette: usize,
    /// Rounds of k-means for the palette.
    pub kmeans_rounds: usize,
    /// Gaussians in the first tier of a node; 0: 40 % of them, at least 4096.
    pub tier: usize,
    /// Effort of deflate, 0 to 9.
    pub deflate_level: u32,
    /// Seed of the palette's start.
    pub seed: u64,
    /// Bits of the codes.
    pub depths: Depths,
    /// Rates of a bitrate ladder, bits per second, rising; empty: none.
    pub ladder: Vec<f64>,
    /// Bytes that are added to the file later and count in these rates: sound.
    pub later: u64,
}

impl Default for WriteConfig {
    fn default() -> Self {
        Self {
            palette: 8192,
            kmeans_rounds: 8,
            tier: 0,
            deflate_level: 6,
            seed: 0,
            depths: Depths::default(),
            ladder: Vec::new(),
            later: 0,
        }
    }
}

/// Root mean square and largest of some differences.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ErrorStat {
    /// Root mean square.
    pub rms: f64,
    /// Largest.
    pub max: f64,
    count: f64,
}

impl ErrorStat {
    fn add(&mut self, difference: f64) {
        let d = difference.abs();
        self.max = self.max.max(d);
        // Until `finish` the sum of squares is in `rms`.
        self.rms += d * d;
        self.count += 1.0;
    }

    fn finish(&mut self) {
        self.rms = (self.rms / f64::max(self.count, 1.0)).sqrt();
    }
}

/// Errors of quantisation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    /// Means in the middle of lifespans, per axis, scene units.
    pub mean: ErrorStat,
    /// Scales, difference of logarithms; those below 1/1000 of the Gaussian's largest are taken for 1/1000, as written.
    pub scale: ErrorStat,
    /// Rotations in the middle of lifespans, radians.
    pub rotation: ErrorStat,
    /// Opacity in the middle of lifespans.
    pub opacity: ErrorStat,
    /// Half-widths and softness of lifespans, seconds.
    pub life: ErrorStat,
    /// Velocities, scene units per second and axis.
    pub velocity: ErrorStat,
    /// Angular velocities, radians a second and axis.
    pub turn: ErrorStat,
    /// Base colours, per channel.
    pub base_color: ErrorStat,
    /// Coefficients of the spherical harmonics above degree 0.
    pub sh: ErrorStat,
}

/// Sizes and counts of a written file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Summary {
    /// Bytes of the file.
    pub bytes: u64,
    /// Pages.
    pub pages: usize,
    /// Records in all pages.
    pub gaussians: usize,
    /// Entries of the palette, 0 where there is none.
    pub palette_entries: usize,
    /// Stored bytes of all pages.
    pub page_bytes: u64,
    /// Stored bytes of all masks.
    pub mask_bytes: u64,
    /// Stored bytes of the palette.
    pub palette_bytes: u64,
    /// Stored bytes of the poster.
    pub poster_bytes: u64,
    /// Errors of quantisation.
    pub errors: Errors,
}

/// What Gaussians of degree 1 and more refer to: the palette, and every Gaussian's entry by node.
type Coded = (Option<Palette>, Vec<Vec<u16>>);

/// A file in the making: sections one by one, and what they weigh.
pub(super) struct Sections {
    pub file: Index,
    bodies: Vec<Vec<u8>>,
    level: u32,
    /// Labels and features by the section of their page: written behind everything that is rendered.
    labels: Vec<(u32, Vec<u8>)>,
    features: Vec<(u32, Vec<u8>)>,
    /// A poster that is written last.
    late: Option<Vec<u8>>,
    pub summary: Summary,
}

impl Sections {
    /// Begins a file: with its poster, where that is small. Errors: metadata out of range.
    pub(super) fn new(meta: Meta, poster: Option<&[u8]>, level: u32) -> Result<Self> {
        meta.check()?;
        let summary = Summary { gaussians: meta.gaussians, ..Summary::default() };
        let file = Index { version: FIRST_VERSION, file_len: 0, meta, sections: Vec::new() };
        let mut out =
            Self { file, bodies: Vec::new(), level, labels: Vec::new(), features: Vec::new(), late: None, summary };
        match poster.filter(|p| !p.is_empty()) {
            Some(p) if p.len() <= SMALL_POSTER => out.summary.poster_bytes = out.add(entry(Kind::Poster), p.to_vec()),
            p => out.late = p.map(<[u8]>::to_vec),
        }
        Ok(out)
    }

    /// Adds a section; returns its stored bytes.
    fn add(&mut self, entry: Entry, body: Vec<u8>) -> u64 {
        let (entry, stored) = pack(entry, body, self.level);
        let size = u64::from(entry.stored);
        self.file.sections.push(entry);
        self.bodies.push(stored);
        size
    }

    pub(super) fn palette(&mut self, p: &Palette) {
        let degree = p.degree as u16;
        let e = Entry { degree, count: p.entries as u32, required: true, ..entry(Kind::Palette) };
        self.summary.palette_bytes = self.add(e, p.bytes());
        self.summary.palette_entries = p.entries;
    }

    /// A page of `count` Gaussians from its decoded bytes; `palette` is that one's number.
    pub(super) fn page(&mut self, body: Vec<u8>, page: &PageEntry) {
        self.summary.page_bytes += self.add(page.entry(), body);
        self.summary.pages += 1;
    }

    /// Masks of the page that was added last. Errors: more key times than a file holds.
    pub(super) fn masks(&mut self, masks: &KeyMasks) -> Result<()> {
        let body = mask::bytes(masks)?;
        let times = masks.times();
        let page = Some(self.file.sections.len() as u32 - 1);
        let span = [times[0], times[times.len() - 1]];
        let e = Entry { count: masks.rows() as u32, span, page, ..entry(Kind::Masks) };
        self.summary.mask_bytes += self.add(e, body);
        Ok(())
    }

    /// Labels of the page that was added last, one per Gaussian.
    pub(super) fn labels(&mut self, of: impl Iterator<Item = Option<u8>>) {
        let page = self.last_page();
        self.labels.extend(labels::bytes(of).map(|bytes| (page, bytes)));
    }

    /// Features of the page that was added last, those of a Gaussian after the other.
    pub(super) fn features<'a>(&mut self, of: impl Iterator<Item = &'a [f32]>) {
        let (page, bytes) = (self.last_page(), features::bytes(&self.file.meta.features, of));
        self.features.extend(bytes.map(|bytes| (page, bytes)));
    }

    fn last_page(&self) -> u32 {
        self.file.sections.iter().rposition(|e| e.kind == Kind::Page).expect("a page was added") as u32
    }

    /// Adds what is behind everything that is rendered, and places all sections.
    fn complete(&mut self) -> &Index {
        for (page, body) in std::mem::take(&mut self.labels) {
            self.add(Entry { count: body.len() as u32, page: Some(page), ..entry(Kind::Labels) }, body);
        }
        let channels = self.file.meta.features.len().max(1);
        for (page, body) in std::mem::take(&mut self.features) {
            let count = (body.len() / channels) as u32;
            self.add(Entry { count, page: Some(page), ..entry(Kind::Features) }, body);
        }
        self.file.version = self.file.least_version();
        if let Some(p) = self.late.take() {
            self.summary.poster_bytes = self.add(entry(Kind::Poster), p);
        }
        self.file.bytes(GENERATOR);
        &self.file
    }

    /// Writes the file. Errors: the sink's.
    pub(super) fn finish(mut self, out: &mut dyn Write) -> Result<Summary> {
        self.complete();
        let head = self.file.bytes(GENERATOR);
        self.summary.bytes = self.file.file_len;
        self.summary.errors.finish();
        let mut write =
            |bytes: &[u8]| out.write_all(bytes).map_err(|e| Error::environment("the scene could not be written", e));
        write(&head)?;
        self.bodies.iter().try_for_each(|b| write(b))?;
        Ok(self.summary)
    }
}

/// A page's fields in the table of sections.
pub(super) struct PageEntry {
    pub tier: u16,
    pub count: usize,
    pub span: [f64; 2],
    pub palette: Option<u32>,
}

impl PageEntry {
    fn entry(&self) -> Entry {
        let &Self { tier, count, span, palette } = self;
        Entry { required: true, tier, count: count as u32, span, palette, ..entry(Kind::Page) }
    }
}

/// Writes a playback file. The order of a node's primitives does not matter, but decides between equals.
///
/// Errors: numbers that are not finite, spans, depths or metadata out of range, the sink's.
/// Panics: a node has more than 4 billion Gaussians.
pub fn write(draft: &Draft, config: &WriteConfig, out: &mut dyn Write) -> Result<Summary> {
    config.depths.check()?;
    draft.meta.check()?;
    draft
        .nodes
        .iter()
        .enumerate()
        .try_for_each(|(i, n)| check(n, &draft.meta).map_err(|e| e.at(format!("node {i}"))))?;
    let coded = palette(draft, config);
    let file = if config.ladder.is_empty() {
        assemble(draft, config, &coded, tiers(draft, config), &[])?
    } else {
        climb(draft, config, &coded)?
    };
    file.finish(out)
}

/// A file with a ladder: its tiers are chosen again with the bytes that they took, until they are within the rates.
fn climb(draft: &Draft, config: &WriteConfig, coded: &Coded) -> Result<Sections> {
    let mut ladder = Ladder::new(draft, &config.ladder)?;
    let (mut beside, mut best) = (0.0, None);
    loop {
        let (tiers, rungs) = ladder.tiers(beside, &|rows| first_tier(rows, config));
        let mut file = assemble(draft, config, coded, tiers, &rungs)?;
        let index = file.complete();
        let next = ladder.examine(index, config.later, &rungs)?;
        let pages: u64 = index.pages().map(|(_, e)| u64::from(e.stored)).sum();
        beside = (index.file_len - pages + config.later) as f64;
        if next != Next::Smaller {
            file.file.meta.ladder = ladder::stated(&file.file, config.later, &rungs, config.ladder.len());
            best = Some(file);
        }
        if let Some(file) = best.take_if(|_| next == Next::Done || ladder.is_tired()) {
            return Ok(file);
        }
    }
}

/// A file of these tiers: first what the first image needs, the important Gaussians of the clip's start in their base
/// colours, what colours them, the rest of them; then time continues. Each rung is behind the whole one before it.
fn assemble(
    draft: &Draft,
    config: &WriteConfig,
    (palette, entries): &Coded,
    mut tiers: Vec<Tier>,
    rungs: &[Rung],
) -> Result<Sections> {
    let mut meta = draft.meta.clone();
    meta.gaussians = draft.nodes.iter().map(|n| n.primitives.len()).sum();
    meta.ladder = rungs.to_vec();
    let mut file = Sections::new(meta, draft.poster.as_deref(), config.deflate_level)?;
    let start = draft.meta.clip[0];
    let holds = |p: &Tier| draft.nodes[p.node].from <= start && start < draft.nodes[p.node].to;
    let rung = |p: &Tier| rungs.iter().position(|r| p.tier < r.tiers);
    tiers.sort_by(|a, b| {
        let (na, nb) = (&draft.nodes[a.node], &draft.nodes[b.node]);
        let (first_a, first_b) = (holds(a), holds(b));
        let by_time = na.from.total_cmp(&nb.from).then(nb.to.total_cmp(&na.to)).then(a.node.cmp(&b.node));
        let by_tier = a.tier.cmp(&b.tier);
        // At the start all nodes are needed at once, and a tier goes before a node; later the order is reversed.
        let by_need = if first_a && first_b { by_tier.then(by_time) } else { by_time.then(by_tier) };
        rung(a).cmp(&rung(b)).then(first_b.cmp(&first_a)).then(by_need)
    });
    let before = tiers.iter().take_while(|p| p.tier == 0 && holds(p)).count();
    let palette_at = (file.file.sections.len() + before) as u32;
    for place in 0..=tiers.len() {
        if place == before
            && let Some(p) = palette
        {
            file.palette(p);
        }
        let Some(piece) = tiers.get_mut(place) else { break };
        let node = &draft.nodes[piece.node];
        let span = [node.from, node.to];
        order::sort(&mut piece.rows, &node.primitives, span);
        let rows: Vec<_> = piece
            .rows
            .iter()
            .map(|&i| (&node.primitives[i as usize], entries.get(piece.node).map_or(0, |l| l[i as usize])))
            .collect();
        let body = encode_page(&rows, span, &config.depths);
        let palette_at = palette.is_some().then_some(palette_at);
        let entry = PageEntry { tier: piece.tier, count: rows.len(), span, palette: palette_at };
        let page = parse_page(&body, &entry.entry()).expect("a page that was just written");
        compare(&mut file.summary.errors, &page, &rows, palette.as_ref());
        file.page(body, &entry);
        if !draft.meta.labels.is_empty() {
            file.labels(rows.iter().map(|(p, _)| p.label));
        }
        file.features(rows.iter().map(|(p, _)| p.features.as_slice()));
    }
    Ok(file)
}

/// An entry of a kind, all else empty.
fn entry(kind: Kind) -> Entry {
    Entry::plain(kind, &[])
}

/// Bytes before a section's byte planes, and bytes per plane.
fn runs(entry: &Entry) -> (usize, usize) {
    let count = entry.count as usize;
    match entry.kind {
        Kind::Page => (4 * BLOCK_HEADER * count.div_ceil(BLOCK_GAUSSIANS), count),
        Kind::Palette => (RANGE_BYTES, count),
        Kind::Masks => {
            let keys = mask_keys(count, entry.bytes as usize).expect("masks that were just written");
            (MASK_HEAD + 8 * keys, count.div_ceil(8))
        }
        Kind::Features => (0, count),
        _ => (entry.bytes as usize, 1),
    }
}

/// Deflates a section where that makes it smaller; images are compressed already.
fn pack(mut entry: Entry, body: Vec<u8>, level: u32) -> (Entry, Vec<u8>) {
    entry.bytes = u32::try_from(body.len()).expect("a section has less than 4 GiB");
    let mut stored = body;
    if entry.kind != Kind::Poster {
        let (head, run) = runs(&entry);
        let small = deflate(&stored, head, run, level.min(9));
        if small.len() < stored.len() {
            (stored, entry.codec) = (small, Codec::Deflate);
        }
    }
    (entry.stored, entry.crc) = (stored.len() as u32, crc(&stored));
    (entry, stored)
}

/// Refuses what cannot be written.
fn check(node: &Node, meta: &Meta) -> Result<()> {
    let (labels, channels) = (meta.labels.len(), meta.features.len());
    if !(node.from.is_finite() && node.to.is_finite() && node.from < node.to) {
        return Err(Error::input(format!("a part of a scene cannot last from {} to {} s", node.from, node.to)));
    }
    assert!(u32::try_from(node.primitives.len()).is_ok(), "a node has at most 4 billion Gaussians");
    for (i, p) in node.primitives.iter().enumerate() {
        if let Some(label) = p.label.filter(|&l| labels > 0 && usize::from(l) >= labels) {
            return Err(Error::input(format!("Gaussian {i} has label {label} of {labels}")));
        }
        let known = p.features.is_empty() || p.features.len() == channels;
        if channels > 0 && !(known && p.features.iter().all(|x| x.is_finite())) {
            return Err(Error::input(format!("Gaussian {i} has features that are not {channels} numbers")));
        }
        let numbers = p.mean.iter().chain([&p.center, &p.softness]).all(|x| (*x as f32).is_finite());
        let shape = p.quat.iter().chain(&p.scales).chain(&p.velocity).chain(&p.turn);
        let color = p.base_color.iter().chain(&p.sh_rest).chain([&p.opacity, &p.importance]);
        if !numbers || p.half_width.is_nan() || !shape.chain(color).all(|x| x.is_finite()) {
            return Err(Error::input(format!("Gaussian {i} holds NaN or infinity"))
                .remedy("Leave it out, or train or export the scene again"));
        }
    }
    Ok(())
}

/// Gaussians of the first tier of `rows`.
fn first_tier(rows: usize, config: &WriteConfig) -> usize {
    let share = ((rows as f64 * FIRST_TIER) as usize).max(SMALLEST_TIER);
    let first = if config.tier > 0 { config.tier } else { share }.min(MAX_PAGE_GAUSSIANS);
    // A rest that is smaller than its tier does not justify another request.
    if rows < 2 * first && rows <= MAX_PAGE_GAUSSIANS { rows } else { first.min(rows) }
}

/// What the first tiers are multiplied with, so that those of any one time are a coarse image of less than 1 MB.
fn coarse_share(nodes: &[Node], first: impl Fn(usize) -> usize) -> f64 {
    let edges = |(n, first): (&Node, f64)| [(n.from, first), (n.to, -first)];
    let mut edges: Vec<(f64, f64)> =
        nodes.iter().map(|n| (n, first(n.primitives.len()) as f64)).flat_map(edges).collect();
    // Where one span ends and another begins, only one of them is rendered.
    edges.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let sums = edges.iter().scan(0.0, |sum, (_, first)| {
        *sum += first;
        Some(*sum)
    });
    (FIRST_GAUSSIANS / sums.fold(1.0, f64::max)).min(1.0)
}

/// Divides nodes into pages: the first tier, then the rest, by importance.
fn tiers(draft: &Draft, config: &WriteConfig) -> Vec<Tier> {
    let mut out = Vec::new();
    let coarse = if config.tier > 0 { 1.0 } else { coarse_share(&draft.nodes, |rows| first_tier(rows, config)) };
    for (node, n) in draft.nodes.iter().enumerate() {
        let mut rows: Vec<u32> = (0..n.primitives.len() as u32).collect();
        let importance = |i: u32| n.primitives[i as usize].importance;
        rows.sort_by(|&a, &b| importance(b).total_cmp(&importance(a)).then(a.cmp(&b)));
        let first = first_tier(rows.len(), config);
        for (tier, rows) in ladder::pages(&rows, first, coarse).into_iter().enumerate() {
            out.push(Tier { node, tier: tier.min(usize::from(u16::MAX)) as u16, rows: rows.to_vec() });
        }
    }
    out
}

/// The palette, and every Gaussian's entry by node. None, and no labels, for scenes of degree 0.
fn palette(draft: &Draft, config: &WriteConfig) -> Coded {
    let degree = draft.meta.sh_degree;
    let width = 3 * (sh::coeffs(degree) - 1);
    let all = || draft.nodes.iter().flat_map(|n| &n.primitives);
    let n = all().count();
    if width == 0 || n == 0 {
        return (None, Vec::new());
    }
    let importance = |p: &super::Primitive| f64::from(p.importance.max(0.0));
    let mean = all().map(importance).sum::<f64>() / n as f64;
    let weight = |p| if mean > 0.0 { (importance(p) / mean) as f32 } else { 1.0 };
    let points = all().map(|p| (&p.sh_rest[..width], weight(p).clamp(WEIGHTS[0], WEIGHTS[1])));
    let worth = (n / GAUSSIANS_PER_ENTRY).max(SMALL_PALETTE);
    let affordable = ladder::palette_entries(draft, &config.ladder, width);
    let entries = config.palette.clamp(1, MAX_PALETTE).min(worth).min(affordable);
    let clusters = cluster(points, width, entries, config.kmeans_rounds, Rng::new(config.seed, "palette", 0));
    let mut labels = clusters.labels.iter().map(|&l| l as u16);
    let by_node = draft.nodes.iter().map(|n| labels.by_ref().take(n.primitives.len()).collect()).collect();
    (Some(Palette::new(degree, &clusters.centroids)), by_node)
}

/// Adds a page's errors.
fn compare(errors: &mut Errors, page: &Page, rows: &[(&super::Primitive, u16)], palette: Option<&Palette>) {
    for (i, (p, _)) in rows.iter().enumerate() {
        let r = page.record(i);
        let delta = r.center - p.center;
        let scales = super::page::scales(p);
        for k in 0..3 {
            let velocity = f64::from(p.velocity[k]);
            errors.mean.add(r.mean[k] - p.mean[k] - velocity * delta);
            errors.scale.add((r.scales[k] / scales[k]).ln());
            errors.velocity.add(r.velocity[k] - velocity);
            errors.turn.add(r.turn[k] - f64::from(p.turn[k]));
            errors.base_color.add(r.base_color[k] - f64::from(p.base_color[k]));
        }
        let start = quat::normalize(p.quat.map(f64::from)).0;
        let rate = super::page::rate(start, p.turn.map(f64::from));
        let q = quat::normalize::<f64>(std::array::from_fn(|k| start[k] + delta * rate[k])).0;
        let distance = |s: f64| (0..4).map(|k| (q[k] - s * r.quat[k]).powi(2)).sum::<f64>().sqrt();
        errors.rotation.add(4.0 * (distance(1.0).min(distance(-1.0)) / 2.0).asin());
        errors.opacity.add(r.opacity - f64::from(p.opacity));
        if r.half_width.is_finite() {
            errors.life.add(r.half_width - p.half_width);
            errors.life.add(r.softness - p.softness);
        }
        for plane in 0..palette.map_or(0, Palette::width) {
            let value = palette.map_or(0.0, |pal| pal.value(usize::from(r.label), plane));
            errors.sh.add(f64::from(value - p.sh_rest[plane]));
        }
    }
}

impl Errors {
    /// All by name.
    pub fn named(&self) -> [(&'static str, ErrorStat); 9] {
        [
            ("mean", self.mean),
            ("scale", self.scale),
            ("rotation", self.rotation),
            ("opacity", self.opacity),
            ("life", self.life),
            ("velocity", self.velocity),
            ("turn", self.turn),
            ("base colour", self.base_color),
            ("spherical harmonics", self.sh),
        ]
    }

    fn finish(&mut self) {
        let Self { mean, scale, rotation, opacity, life, velocity, turn, base_color, sh } = self;
        [mean, scale, rotation, opacity, life, velocity, turn, base_color, sh].into_iter().for_each(ErrorStat::finish);
    }
}

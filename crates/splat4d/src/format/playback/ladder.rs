//! A bitrate ladder: tiers of a file grouped into rungs, each within a rate (docs/format.md, "Ladder").
//!
//! A rung has the Gaussians whose importance is greatest for the bytes that they take of each second. A price of a byte
//! in each window of the clip decides: a Gaussian belongs to the rung if its importance over the span of its node
//! exceeds the price of its bytes there. Prices rise in windows that are over the rate and fall in others. What a page
//! really takes is known only after it is deflated, so that the writer repeats the choice with what it measured.

use super::rungs::check;
use super::{Draft, Index, Kind, MAX_PAGE_GAUSSIANS, Rung};
use crate::{Error, Result};

/// Most Gaussians in the first tiers of one time, so that a coarse image needs less than 1 MB: a Gaussian has 18 to 24
/// bytes, and index and poster take some of it.
pub(super) const FIRST_GAUSSIANS: f64 = 32_000.0;
/// Most windows of a clip, about three hours: longer clips have longer windows.
const MOST_WINDOWS: usize = 10_000;
/// Bytes of a Gaussian before any was deflated.
const BYTES_EACH: f64 = 24.0;
/// Fewer Gaussians than this are not a page of their own next to another page of the node: a request and an entry of
/// the index cost as much as some of them.
const SMALLEST: usize = 64;
/// Share of a second at the first rate that the pages of the first image may take, the rest being for what is before
/// them.
const FIRST_IMAGE: f64 = 0.6;
/// Share of the bytes at the first rate that the palette may take.
const PALETTE: f64 = 0.1;
/// Where a first tier is small, each one behind it has this many times the Gaussians of the one before.
const GROWTH: usize = 2;
/// Rounds of the search for prices, and of encoding.
const PRICING: usize = 40;
const ROUNDS: usize = 10;
/// A rung that has this share of its rate is full.
const FULL: f64 = 0.97;
/// The rate of what exceeds the highest one, as a multiple of that, until it is measured.
const UNKNOWN: f64 = 1000.0;
/// The next choice aims at this share of the rate.
const AIM: f64 = 0.99;

/// Equal windows of at least a second over which rates are averaged; a shorter clip is one window of a second.
#[derive(Clone, Copy, Debug)]
pub(super) struct Windows {
    from: f64,
    seconds: f64,
    count: usize,
}

impl Windows {
    pub(super) fn of(spans: impl Iterator<Item = [f64; 2]>) -> Self {
        let [from, to] = spans.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], [from, to]| [a.min(from), b.max(to)]);
        let length = if to > from { to - from } else { 0.0 };
        // A length that is a hair short of a whole number of seconds is one.
        let count = ((length + 1e-6) as usize).clamp(1, MOST_WINDOWS);
        Self { from, seconds: (length / count as f64).max(1.0), count }
    }

    /// Spreads an amount evenly over a span, and adds what falls into each window.
    fn spread(&self, out: &mut Spread, [from, to]: [f64; 2], amount: f64) {
        let [a, b] = [from, to].map(|t| ((t - self.from) / self.seconds).clamp(0.0, self.count as f64));
        let (first, last) = ((a as usize).min(self.count - 1), (b as usize).min(self.count - 1));
        if first == last || b - a <= 0.0 {
            out.own[first] += amount;
            return;
        }
        let each = amount / (b - a);
        out.own[first] += each * (first as f64 + 1.0 - a);
        out.own[last] += each * (b - last as f64);
        out.steps[first + 1] += each;
        out.steps[last] -= each;
    }

    /// Mean of a value by window over a span, from its running sums.
    fn mean(&self, sums: &[f64], [from, to]: [f64; 2]) -> f64 {
        let [a, b] = [from, to].map(|t| ((t - self.from) / self.seconds).clamp(0.0, self.count as f64));
        let upto = |x: f64| {
            let whole = (x as usize).min(self.count - 1);
            sums[whole] + (sums[whole + 1] - sums[whole]) * (x - whole as f64)
        };
        if b > a { (upto(b) - upto(a)) / (b - a) } else { 0.0 }
    }
}

/// Amounts by window: those of windows that a span covers in part, and steps of those that it covers in full.
struct Spread {
    own: Vec<f64>,
    steps: Vec<f64>,
}

impl Spread {
    fn new(windows: &Windows) -> Self {
        Self { own: vec![0.0; windows.count], steps: vec![0.0; windows.count + 1] }
    }

    fn sums(self) -> Vec<f64> {
        let mut running = 0.0;
        let add = |(own, step): (f64, f64)| {
            running += step;
            own + running
        };
        self.own.into_iter().zip(self.steps).map(add).collect()
    }
}

impl Index {
    /// Bits per second of the pages with a tier below `tiers` and of what every player loads with them (index, poster,
    /// palettes, sound), in each window. A page counts evenly over its span, everything else evenly over the clip.
    pub(super) fn bits_per_second(&self, tiers: u16) -> Vec<f64> {
        let windows = Windows::of(self.pages().map(|(_, e)| e.span));
        let mut spread = Spread::new(&windows);
        let mut beside = self.file_len.saturating_sub(self.sections.iter().map(|e| u64::from(e.stored)).sum()) as f64;
        for e in &self.sections {
            let page = match e.kind {
                Kind::Page => Some(e),
                Kind::Masks => e.page.and_then(|page| self.sections.get(page as usize)),
                Kind::Palette | Kind::Poster | Kind::Sound => {
                    beside += f64::from(e.stored);
                    None
                }
                _ => None,
            };
            if let Some(page) = page.filter(|p| p.tier < tiers) {
                windows.spread(&mut spread, page.span, f64::from(e.stored));
            }
        }
        let each = beside / windows.count as f64;
        spread.sums().into_iter().map(|bytes| 8.0 * (bytes + each) / windows.seconds).collect()
    }

    /// Measures the rungs that the file states.
    pub(super) fn measure_rungs(&mut self) {
        for k in 0..self.meta.ladder.len() {
            let loads = self.bits_per_second(self.meta.ladder[k].tiers);
            let rung = &mut self.meta.ladder[k];
            rung.most = loads.iter().copied().fold(0.0, f64::max);
            rung.mean = loads.iter().sum::<f64>() / loads.len().max(1) as f64;
        }
    }
}

/// Most entries of a palette at the lowest of these rates; an entry has `bytes`.
pub(super) fn palette_entries(draft: &Draft, rates: &[f64], bytes: usize) -> usize {
    let Some(rate) = rates.first() else { return usize::MAX };
    let windows = Windows::of(draft.nodes.iter().map(|n| [n.from, n.to]));
    let all = rate / 8.0 * windows.seconds * windows.count as f64;
    ((PALETTE * all / bytes as f64) as usize).max(1)
}

/// A node's Gaussians by falling importance, and the running choice.
struct Ranked {
    span: [f64; 2],
    rows: Vec<u32>,
    /// Importance over the whole span, falling.
    values: Vec<f64>,
}

/// The choice of Gaussians for rungs, corrected by what pages really take.
pub(super) struct Ladder {
    nodes: Vec<Ranked>,
    windows: Windows,
    start: f64,
    rates: Vec<f64>,
    /// By rung, what its rate is multiplied with before a choice.
    factors: Vec<f64>,
    /// Bytes of a Gaussian.
    bytes: f64,
    /// By rung, the Gaussians of each node.
    counts: Vec<Vec<usize>>,
    round: usize,
}

/// Some Gaussians of a node, most important first, and their tier.
pub(super) struct Tier {
    pub node: usize,
    pub tier: u16,
    pub rows: Vec<u32>,
}

/// What becomes of a choice that was encoded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Next {
    /// It is within its rates and as good as any; the last one that was is to be written.
    Done,
    /// It is within its rates, and a larger one may be.
    Larger,
    /// A rung is over its rate.
    Smaller,
}

impl Ladder {
    /// Errors: rates that do not rise.
    pub(super) fn new(draft: &Draft, rates: &[f64]) -> Result<Self> {
        check(rates)?;
        let ranked = |n: &super::Node| {
            let span = [n.from, n.to];
            let importance = |i: u32| n.primitives[i as usize].importance.max(0.0);
            let mut rows: Vec<u32> = (0..n.primitives.len() as u32).collect();
            rows.sort_by(|&a, &b| importance(b).total_cmp(&importance(a)).then(a.cmp(&b)));
            let values = rows.iter().map(|&i| f64::from(importance(i)) * (span[1] - span[0])).collect();
            Ranked { span, rows, values }
        };
        Ok(Self {
            nodes: draft.nodes.iter().map(ranked).collect(),
            windows: Windows::of(draft.nodes.iter().map(|n| [n.from, n.to])),
            start: draft.meta.clip[0],
            rates: rates.to_vec(),
            factors: vec![AIM; rates.len()],
            bytes: BYTES_EACH,
            counts: Vec::new(),
            round: 0,
        })
    }

    /// Chooses and groups: tiers by node, and the rungs. `beside`: bytes of all that is no page. `first(n)`: Gaussians of
    /// the first tier of n.
    pub(super) fn tiers(&mut self, beside: f64, first: &dyn Fn(usize) -> usize) -> (Vec<Tier>, Vec<Rung>) {
        let mut counts: Vec<Vec<usize>> = Vec::new();
        let all: Vec<usize> = self.nodes.iter().map(|n| n.rows.len()).collect();
        let none = vec![0; all.len()];
        for (&rate, factor) in self.rates.iter().zip(&self.factors) {
            let bytes = rate * factor / 8.0 * self.windows.seconds - beside / self.windows.count as f64;
            let before = counts.last().unwrap_or(&none);
            let chosen = self.choose(bytes.max(0.0), before, &all);
            let whole = chosen == all;
            counts.push(chosen);
            if whole {
                break;
            }
        }
        if counts.last() != Some(&all) {
            counts.push(all);
        }
        let share = self.first_share(&counts[0], first);
        let (mut tiers, mut rungs, mut below) = (Vec::new(), Vec::new(), 0u16);
        for (k, of_nodes) in counts.iter().enumerate() {
            let mut most = 0;
            for (node, &count) in of_nodes.iter().enumerate() {
                let from = if k > 0 { counts[k - 1][node] } else { 0 };
                let rows = &self.nodes[node].rows[from..count];
                let pages = if k > 0 { pages(rows, rows.len(), 1.0) } else { pages(rows, first(rows.len()), share) };
                most = most.max(pages.len());
                let tier = |(i, rows): (usize, &[u32])| Tier { node, tier: below + i as u16, rows: rows.to_vec() };
                tiers.extend(pages.into_iter().enumerate().map(tier));
            }
            below = below.saturating_add(most.max(1) as u16);
            let unknown = UNKNOWN * self.rates[self.rates.len() - 1];
            rungs.push(Rung { rate: self.rates.get(k).copied().unwrap_or(unknown), tiers: below, ..Rung::default() });
        }
        self.counts = counts;
        (tiers, rungs)
    }

    /// Compares an encoded choice with its rates, and corrects the next. `index` is that of the file with it; `later`
    /// are bytes that are added to the file afterwards.
    ///
    /// Errors: what is no page alone exceeds the lowest rate, or no choice is within the rates.
    pub(super) fn examine(&mut self, index: &Index, later: u64, rungs: &[Rung]) -> Result<Next> {
        self.round += 1;
        let pages: f64 = index.pages().map(|(_, e)| f64::from(e.stored)).sum();
        let gaussians: f64 = index.pages().map(|(_, e)| f64::from(e.count)).sum();
        if gaussians > 0.0 {
            self.bytes = pages / gaussians;
        }
        let later = 8.0 * later as f64 / (self.windows.seconds * self.windows.count as f64);
        let (mut over, mut spare) = (false, false);
        for (k, rung) in rungs.iter().enumerate().take(self.rates.len()) {
            let most = index.bits_per_second(rung.tiers).into_iter().fold(0.0, f64::max) + later;
            let share = most / rung.rate;
            let whole = k + 1 == rungs.len();
            if share > 1.0 {
                over = true;
                self.factors[k] *= (AIM / share).min(AIM);
            } else if share < FULL && !whole {
                spare = true;
                self.factors[k] *= (AIM / share).min(1.5);
            }
        }
        let empty = index.bits_per_second(0)[0] + later;
        let done = !over && (!spare || self.round >= ROUNDS);
        let nothing = done && gaussians > 0.0 && self.counts[0].iter().all(|count| *count == 0);
        if empty >= rungs[0].rate || nothing || over && self.round > 2 * ROUNDS {
            return Err(Error::input(format!(
                "invalid ladder: the first rate is {:.2} Mbit/s, and index, poster and palette alone need {:.2} Mbit/s",
                1e-6 * rungs[0].rate,
                1e-6 * empty
            ))
            .remedy("Raise the first rate, or leave out the poster"));
        }
        Ok(match (over, done) {
            (true, _) => Next::Smaller,
            (false, false) => Next::Larger,
            (false, true) => Next::Done,
        })
    }

    /// Whether no more choices are to be tried once one is within its rates.
    pub(super) fn is_tired(&self) -> bool {
        self.round >= ROUNDS
    }

    /// Gaussians of every node within `bytes` in each window, at least those that the rung before has.
    fn choose(&self, bytes: f64, before: &[usize], all: &[usize]) -> Vec<usize> {
        let fits = |counts: &[usize]| self.load(counts).into_iter().all(|b| b <= bytes);
        if fits(all) {
            return all.to_vec();
        }
        let top = self.nodes.iter().filter_map(|n| n.values.first()).fold(f64::MIN_POSITIVE, |a, b| a.max(*b));
        let (mut low, mut high) = (1e-12f64.ln(), 1.0f64.ln());
        for _ in 0..PRICING {
            let middle = 0.5 * (low + high);
            let counts = self.taken(&vec![top * middle.exp(); self.windows.count], before);
            let sum: f64 = self.load(&counts).iter().sum();
            if sum <= bytes * self.windows.count as f64 { high = middle } else { low = middle }
        }
        let mut prices = vec![top * high.exp(); self.windows.count];
        let least = 1e-12 * top;
        for _ in 0..PRICING {
            let load = self.load(&self.taken(&prices, before));
            for (price, load) in prices.iter_mut().zip(load) {
                *price = (*price * (load / bytes.max(1.0)).clamp(0.5, 2.0).powf(0.7)).clamp(least, 2.0 * top);
            }
        }
        // What is left over a rate by a hair.
        let mut factor = 1.0;
        loop {
            let scaled: Vec<f64> = prices.iter().map(|p| p * factor).collect();
            let counts = self.taken(&scaled, before);
            if fits(&counts) || scaled.iter().all(|p| *p > top) {
                return counts;
            }
            factor *= 1.05;
        }
    }

    /// Gaussians of every node that exceed the prices of their bytes, in portions that are a page.
    fn taken(&self, prices: &[f64], before: &[usize]) -> Vec<usize> {
        let mut sums = vec![0.0];
        prices.iter().for_each(|p| sums.push(sums[sums.len() - 1] + p));
        let of = |(node, &before): (&Ranked, &usize)| {
            let (price, n) = (self.windows.mean(&sums, node.span), node.rows.len());
            let count = node.values.partition_point(|v| *v > price).max(before);
            if n < 2 * SMALLEST {
                return if 2 * count >= n { n } else { before };
            }
            match () {
                () if n - count < SMALLEST => n,
                () if count - before < SMALLEST => before,
                () => count,
            }
        };
        self.nodes.iter().zip(before).map(of).collect()
    }

    /// Bytes of pages in every window.
    fn load(&self, counts: &[usize]) -> Vec<f64> {
        let mut spread = Spread::new(&self.windows);
        for (node, &count) in self.nodes.iter().zip(counts) {
            self.windows.spread(&mut spread, node.span, self.bytes * count as f64);
        }
        spread.sums()
    }

    /// What the first tiers are multiplied with, so that those of the clip's start are there soon.
    fn first_share(&self, counts: &[usize], first: &dyn Fn(usize) -> usize) -> f64 {
        let held = |n: &Ranked| n.span[0] <= self.start && self.start < n.span[1];
        let of_start = self.nodes.iter().zip(counts).filter(|(n, _)| held(n)).map(|(_, &count)| first(count));
        let bytes = self.bytes * of_start.sum::<usize>() as f64;
        let most = (FIRST_IMAGE * self.rates[0] / 8.0).min(FIRST_GAUSSIANS * self.bytes);
        (most / bytes.max(1.0)).min(1.0)
    }
}

/// The rungs that a file states: none above the first one that has everything, whose rate is the given one; what exceeds
/// the highest rate has the rate that it needs.
pub(super) fn stated(index: &Index, later: u64, rungs: &[Rung], given: usize) -> Vec<Rung> {
    let Some(last) = rungs.last() else { return Vec::new() };
    let windows = Windows::of(index.pages().map(|(_, e)| e.span));
    let later = 8.0 * later as f64 / (windows.seconds * windows.count as f64);
    let whole = (index.bits_per_second(last.tiers).into_iter().fold(0.0, f64::max) + later).ceil();
    let mut out: Vec<Rung> = rungs.iter().take(given).copied().collect();
    match out.iter().position(|r| whole <= r.rate) {
        Some(k) => {
            out.truncate(k + 1);
            out[k].tiers = last.tiers;
        }
        None => out.push(Rung { rate: whole, tiers: last.tiers, ..Rung::default() }),
    }
    out
}

/// Rows as pages: the first `head`, then the rest, in equal parts where a page does not hold it. `share` below 1 makes
/// the first one smaller by as much, and those behind it grow from there.
pub(super) fn pages(rows: &[u32], head: usize, share: f64) -> Vec<&[u32]> {
    let small = (head as f64 * share) as usize;
    let head = small.clamp(rows.len().min(1), rows.len()).min(MAX_PAGE_GAUSSIANS);
    let (first, mut rest) = rows.split_at(head);
    let mut out = vec![first];
    let mut size = if share < 1.0 { GROWTH * head.max(SMALLEST) } else { usize::MAX };
    while rest.len() > size && size < MAX_PAGE_GAUSSIANS {
        let (next, behind) = rest.split_at(size);
        out.push(next);
        (rest, size) = (behind, GROWTH * size);
    }
    let size = rest.len().div_ceil(rest.len().div_ceil(MAX_PAGE_GAUSSIANS).max(1)).max(1);
    out.extend(rest.chunks(size));
    out.retain(|page| !page.is_empty());
    out
}

//! Lags by sound: the beginnings of sounds over the whole recording, then the waveform.

use super::fft::{Complex, Fft, correlate, times};
use super::{NORMAL_MAD, Refusal, median, parabola};
use crate::video::SOUND_RATE;

/// Values of the envelope per second.
const ENVELOPE_RATE: f64 = 200.0;
/// Samples of a value of the envelope: 16 ms, of which neighbours share two thirds.
const ENVELOPE_WINDOW: usize = 256;
/// Borders of the envelope's bands, Hz: evenly spaced on the mel scale, from above rumble to where phones still hear
/// well.
const BANDS: [f64; 5] = [150.0, 640.0, 1420.0, 2680.0, 4700.0];
/// A band's silence, relative to its mean energy: below it there are no onsets.
const FLOOR: f64 = 1e-3;
/// Lags that are examined closely: the coarse search may prefer a neighbour of the right one.
const CANDIDATES: usize = 4;
/// Candidates are this many seconds apart.
const CANDIDATE_GAP: f64 = 0.05;
/// Tracks share at least this many seconds.
const MIN_OVERLAP: f64 = 1.5;
/// Seconds around a coarse lag that contain the fine one.
const FINE_RANGE: f64 = 0.2;
/// Frequencies that the waveform is compared at, Hz: below, rooms boom; above, codecs save.
const FINE_BAND: [f64; 2] = [200.0, 6000.0];
/// Amplitudes below this part of the mean are not whitened: they are noise of rounding.
const WHITEN_FLOOR: f64 = 1e-3;
/// Windows of the waveform that are compared, at most, evenly spread.
const WINDOWS: usize = 12;
/// Shortest and longest window, seconds.
const WINDOW: [f64; 2] = [0.4, 4.0];
/// A second peak is one farther than this from the first, seconds: nearer ones are echoes of walls next to the camera.
const ECHO: f64 = 5e-3;
/// From this ratio of the first peak to the second on a window is clear.
const CLEAR: f64 = 1.5;
/// Clear windows that must agree.
const AGREEING: usize = 3;
/// The part of the clear windows that must.
const AGREEING_PART: f64 = 0.6;
/// Largest median absolute deviation of those that agree, seconds.
const MAX_MAD: f64 = 3e-3;
/// Windows over at least this many seconds are needed to measure a drift of the clocks.
const DRIFT_SPAN: f64 = 60.0;
/// Largest drift of clocks, seconds a second: crystals of phones are within 100 ppm of each other.
const MAX_DRIFT: f64 = 500e-6;
/// Smallest uncertainty that is claimed, seconds: a sixteenth of a sample is an illusion.
const MIN_SIGMA: f64 = 1e-4;
/// Speed of sound, metres per second, in air of 20 °C.
const SPEED: f64 = 343.0;

/// A lag that was heard.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SoundLag {
    /// Seconds that the second track is late, at [`at`](Self::at).
    pub seconds: f64,
    /// The standard deviation of it, seconds, without the travel time of sound.
    pub sigma: f64,
    /// A second of the first track's clock in the middle of what was compared.
    pub at: f64,
    /// Seconds by which the lag grows each second; where the tracks are long enough.
    pub drift: Option<f64>,
    /// Median ratio of the highest peak to the next one in the windows that agree.
    pub ratio: f64,
    /// Windows that agree, and windows that were compared.
    pub windows: [usize; 2],
}

impl SoundLag {
    /// The lag at second 0 of the first track's clock.
    pub(crate) fn at_zero(&self) -> f64 {
        self.seconds - self.drift.unwrap_or(0.0) * self.at
    }
}

/// A lag corrected for the travel time of sound: b records the source `lag` later than a, and the source has these
/// distances from either.
pub(crate) fn without_way(lag: f64, [from_a, from_b]: [f64; 2]) -> f64 {
    lag - (from_b - from_a) / SPEED
}

/// Largest travel time of sound between cameras at this distance in metres, seconds.
pub(crate) fn way(metres: f64) -> f64 {
    metres / SPEED
}

/// A sound track, and where sounds begin in it.
pub(crate) struct SoundTrack {
    samples: Vec<f32>,
    onsets: Vec<f64>,
}

impl SoundTrack {
    /// Prepares one channel at `SOUND_RATE`.
    pub(crate) fn new(samples: Vec<f32>) -> Self {
        let onsets = onsets(&samples);
        Self { samples, onsets }
    }

    /// Seconds.
    fn length(&self) -> f64 {
        self.samples.len() as f64 / SOUND_RATE
    }
}

/// How strongly sounds begin, [`ENVELOPE_RATE`] times a second: the rise of the logarithm of the energy, band by band.
/// Zero mean.
fn onsets(samples: &[f32]) -> Vec<f64> {
    let hop = (SOUND_RATE / ENVELOPE_RATE) as usize;
    let count = samples.len().saturating_sub(ENVELOPE_WINDOW) / hop;
    let fft = Fft::new(ENVELOPE_WINDOW);
    let window: Vec<f64> = (0..ENVELOPE_WINDOW)
        .map(|i| 0.5 - 0.5 * (std::f64::consts::TAU * (i as f64 + 0.5) / ENVELOPE_WINDOW as f64).cos())
        .collect();
    let bin = |hz: f64| (hz / SOUND_RATE * ENVELOPE_WINDOW as f64).round() as usize;
    let mut energy = vec![[0.0; BANDS.len() - 1]; count];
    let mut x = vec![[0.0; 2]; ENVELOPE_WINDOW];
    for (k, bands) in energy.iter_mut().enumerate() {
        for (i, v) in x.iter_mut().enumerate() {
            *v = [f64::from(samples[k * hop + i]) * window[i], 0.0];
        }
        fft.forward(&mut x);
        for (b, sum) in bands.iter_mut().enumerate() {
            *sum = (bin(BANDS[b])..bin(BANDS[b + 1])).map(|i| x[i][0] * x[i][0] + x[i][1] * x[i][1]).sum();
        }
    }
    let mut out = vec![0.0; count];
    for b in 0..BANDS.len() - 1 {
        let mean = energy.iter().map(|e| e[b]).sum::<f64>() / count.max(1) as f64;
        if mean <= 0.0 {
            continue;
        }
        let log: Vec<f64> = energy.iter().map(|e| (e[b] / mean + FLOOR).ln()).collect();
        let rises: Vec<f64> = (0..count).map(|k| (log[k] - log[k.saturating_sub(2)]).max(0.0)).collect();
        let scale = rises.iter().map(|r| r * r).sum::<f64>().sqrt();
        if scale > 0.0 {
            out.iter_mut().zip(&rises).for_each(|(o, r)| *o += r / scale);
        }
    }
    let mean = out.iter().sum::<f64>() / count.max(1) as f64;
    out.iter_mut().for_each(|o| *o -= mean);
    out
}

/// How much later b notes what a notes, by their sound; at most `most` seconds either way, if given.
pub(crate) fn lag(a: &SoundTrack, b: &SoundTrack, most: Option<f64>) -> Result<SoundLag, Refusal> {
    if a.length() < MIN_OVERLAP || b.length() < MIN_OVERLAP {
        return Err(Refusal::Short("sound"));
    }
    if [a, b].iter().any(|t| t.onsets.iter().all(|v| *v == 0.0)) {
        return Err(Refusal::Silent);
    }
    let mut best: Option<SoundLag> = None;
    let mut why = Refusal::Unrelated;
    for coarse in candidates(a, b, most) {
        match fine(a, b, coarse) {
            Ok(found) => {
                if best.is_none_or(|b| found.windows[0] > b.windows[0]) {
                    best = Some(found);
                }
            }
            Err(Refusal::Unrelated) => {}
            Err(other) => why = other,
        }
    }
    best.ok_or(why)
}

/// The lags at which onsets agree best, the best first.
fn candidates(a: &SoundTrack, b: &SoundTrack, most: Option<f64>) -> Vec<f64> {
    let sums = correlate(&a.onsets, &b.onsets);
    let (n, m) = (a.onsets.len(), b.onsets.len());
    let squares = |v: &[f64]| {
        let mut sum = 0.0;
        std::iter::once(0.0)
            .chain(v.iter().map(|x| {
                sum += x * x;
                sum
            }))
            .collect::<Vec<f64>>()
    };
    let (square_a, square_b) = (squares(&a.onsets), squares(&b.onsets));
    // The correlation times the root of how much was compared: a standard score, were the tracks unrelated.
    let score = |at: usize| {
        let lag = at as isize - (n as isize - 1);
        let begin = (-lag).max(0) as usize;
        let end = (m as isize - lag).min(n as isize) as usize;
        let overlap = (end - begin) as f64;
        if overlap < MIN_OVERLAP * ENVELOPE_RATE || most.is_some_and(|w| lag.abs() as f64 > w * ENVELOPE_RATE) {
            return f64::NEG_INFINITY;
        }
        let shifted = |i: usize| (i as isize + lag) as usize;
        let power = (square_a[end] - square_a[begin]) * (square_b[shifted(end)] - square_b[shifted(begin)]);
        if power > 0.0 { sums[at] / power.sqrt() * overlap.sqrt() } else { f64::NEG_INFINITY }
    };
    let scores: Vec<f64> = (0..sums.len()).map(score).collect();
    let mut order: Vec<usize> = (1..scores.len().saturating_sub(1))
        .filter(|&i| scores[i].is_finite() && scores[i] >= scores[i - 1] && scores[i] > scores[i + 1])
        .collect();
    order.sort_by(|&i, &j| scores[j].total_cmp(&scores[i]).then(i.cmp(&j)));
    let mut out: Vec<f64> = Vec::new();
    for at in order {
        let seconds = (at as f64 - (n as f64 - 1.0)) / ENVELOPE_RATE;
        if out.iter().all(|o| (o - seconds).abs() > CANDIDATE_GAP) {
            out.push(seconds);
        }
        if out.len() == CANDIDATES {
            break;
        }
    }
    out
}

/// The lag near a coarse one, by the waveforms of several windows.
fn fine(a: &SoundTrack, b: &SoundTrack, coarse: f64) -> Result<SoundLag, Refusal> {
    // Common seconds on a's clock, with a margin for the search.
    let begin = (FINE_RANGE - coarse).max(0.0);
    let end = (b.length() - FINE_RANGE - coarse).min(a.length());
    let length = ((end - begin) / (AGREEING + 1) as f64).clamp(WINDOW[0], WINDOW[1]);
    let count = (((end - begin) / length) as usize).min(WINDOWS);
    if end <= begin || count < AGREEING {
        return Err(Refusal::Short("sound"));
    }
    let step = (end - begin - length) / (count - 1) as f64;
    let phat = Phat::new(length);
    let mut clear: Vec<Window> = Vec::new();
    for k in 0..count {
        let from = begin + step * k as f64;
        if let Some((lag, ratio)) = phat.lag(&a.samples, &b.samples, from, coarse)
            && ratio >= CLEAR
        {
            clear.push(Window { at: from + 0.5 * length, lag, ratio });
        }
    }
    if clear.len() < AGREEING {
        return Err(Refusal::Unrelated);
    }
    let span = clear[clear.len() - 1].at - clear[0].at;
    let drift = (span >= DRIFT_SPAN).then(|| slope(&clear));
    if let Some(drift) = drift.filter(|d| d.abs() > MAX_DRIFT) {
        return Err(Refusal::Drifting(drift));
    }
    let at = 0.5 * (clear[0].at + clear[clear.len() - 1].at);
    let level = |w: &Window| w.lag - drift.unwrap_or(0.0) * (w.at - at);
    let seconds = median(&mut clear.iter().map(level).collect::<Vec<_>>());
    let near: Vec<&Window> = clear.iter().filter(|w| (level(w) - seconds).abs() <= ECHO).collect();
    let mad = median(&mut near.iter().map(|w| (level(w) - seconds).abs()).collect::<Vec<_>>());
    let part = near.len() as f64 / clear.len() as f64;
    if near.len() < AGREEING || part < AGREEING_PART || mad > MAX_MAD {
        return Err(Refusal::Unrelated);
    }
    Ok(SoundLag {
        seconds,
        sigma: (NORMAL_MAD * mad / (near.len() as f64).sqrt()).max(MIN_SIGMA),
        at,
        drift,
        ratio: median(&mut near.iter().map(|w| w.ratio).collect::<Vec<_>>()),
        windows: [near.len(), count],
    })
}

/// Evidence of a window.
struct Window {
    /// Its middle, on a's clock.
    at: f64,
    lag: f64,
    ratio: f64,
}

/// The median of the slopes of all pairs (Theil 1950, Sen 1968).
fn slope(windows: &[Window]) -> f64 {
    let mut slopes = Vec::new();
    for (i, a) in windows.iter().enumerate() {
        slopes.extend(windows[i + 1..].iter().map(|b| (b.lag - a.lag) / (b.at - a.at)));
    }
    median(&mut slopes)
}

/// Generalised cross-correlation with phase transform (Knapp and Carter 1976): where all frequencies agree on a delay,
/// however loud each is.
struct Phat {
    fft: Fft,
    /// Samples of a window, and of the transform.
    length: usize,
    n: usize,
}

impl Phat {
    fn new(seconds: f64) -> Self {
        let length = (seconds * SOUND_RATE) as usize;
        let n = (length + 2 * (FINE_RANGE * SOUND_RATE) as usize).next_power_of_two();
        Self { fft: Fft::new(n), length, n }
    }

    /// The lag near `coarse` of the window of a that begins at second `from`, and the prominence of its peak.
    fn lag(&self, a: &[f32], b: &[f32], from: f64, coarse: f64) -> Option<(f64, f64)> {
        let range = (FINE_RANGE * SOUND_RATE) as isize;
        let first = (from * SOUND_RATE) as isize;
        let second = ((from + coarse) * SOUND_RATE).round() as isize - range;
        let take = |samples: &[f32], from: isize, count: usize| -> Vec<Complex> {
            let at = |i: usize| from.checked_add(i as isize).and_then(|k| samples.get(usize::try_from(k).ok()?));
            let value = |i: usize| if i < count { at(i).map_or(0.0, |v| f64::from(*v)) } else { 0.0 };
            (0..self.n).map(|i| [value(i), 0.0]).collect()
        };
        let mut x = take(a, first, self.length);
        let mut y = take(b, second, self.length + 2 * range as usize);
        // Edges would be heard as clicks.
        for (i, v) in x[..self.length].iter_mut().enumerate() {
            v[0] *= (std::f64::consts::PI * (i as f64 + 0.5) / self.length as f64).sin().sqrt();
        }
        self.fft.forward(&mut x);
        self.fft.forward(&mut y);
        let bin = |hz: f64| (hz / SOUND_RATE * self.n as f64).round() as usize;
        let band = bin(FINE_BAND[0])..bin(FINE_BAND[1]);
        let cross = |k: usize| times([x[k][0], -x[k][1]], y[k]);
        let size = |c: Complex| c[0].hypot(c[1]);
        let mean = band.clone().map(|k| size(cross(k))).sum::<f64>() / band.len() as f64;
        if mean <= 0.0 {
            return None;
        }
        let mut r = vec![[0.0; 2]; self.n];
        for k in band {
            let c = cross(k);
            let scale = 1.0 / (size(c) + WHITEN_FLOOR * mean);
            r[k] = [c[0] * scale, c[1] * scale];
            r[self.n - k] = [r[k][0], -r[k][1]];
        }
        self.fft.inverse(&mut r);
        let last = 2 * range as usize;
        let best = (1..last).max_by(|&i, &j| r[i][0].total_cmp(&r[j][0])).filter(|&i| r[i][0] > 0.0)?;
        let echo = (ECHO * SOUND_RATE) as usize;
        let second_peak = (0..=last).filter(|i| i.abs_diff(best) > echo).map(|i| r[i][0]).fold(0.0, f64::max);
        let (part, height) = parabola([r[best - 1][0], r[best][0], r[best + 1][0]]);
        let samples = (second - first) as f64 + best as f64 + part;
        Some((samples / SOUND_RATE, height / second_peak.max(f64::MIN_POSITIVE)))
    }
}

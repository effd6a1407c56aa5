//! Curves and bars as inline SVG: no script, no library; colours are those of the page's style sheet, so that they
//! follow light and dark. Every point carries its numbers as a tooltip.

use std::fmt::Write;

const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 246.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 40.0;
/// Points a curve is reduced to (means of equal runs): more cannot be seen at this width.
const MAX_POINTS: usize = 260;
/// Points that get a tooltip.
const MAX_TIPS: usize = 48;
/// Colours that the style sheet defines (`--c0` …). Any two differ by at least 0.12 in OKLab, also as people without one
/// kind of cone see them (Machado et al. 2009); each has a contrast of 3 with the page.
const COLORS: usize = 8;
/// From the ninth curve on colours repeat with dashes: lengths of dashes and gaps, pixels.
const DASHES: [&[f64]; 4] = [&[], &[7.0, 4.0], &[2.0, 3.0], &[9.0, 3.0, 2.0, 3.0]];

type Points = Vec<(f64, f64)>;

/// One curve.
pub struct Series {
    /// Shown in the legend; empty: none.
    pub name: String,
    /// (x, y), x rising.
    pub points: Points,
}

fn pattern(i: usize) -> &'static [f64] {
    DASHES[i / COLORS % DASHES.len()]
}

/// Dashes of a curve, as a style.
fn dashes(i: usize) -> String {
    let lengths: Vec<String> = pattern(i).iter().map(f64::to_string).collect();
    if lengths.is_empty() { String::new() } else { format!(";stroke-dasharray:{}", lengths.join(" ")) }
}

/// A curve's mark in the legend.
fn mark(i: usize) -> String {
    let color = format!("var(--c{})", i % COLORS);
    let mut stops = Vec::new();
    let mut at = 0.0;
    for (k, length) in pattern(i).iter().enumerate() {
        let shown = if k % 2 == 0 { &color } else { "transparent" };
        stops.push(format!("{shown} {at}px {}px", at + length));
        at += length;
    }
    if stops.is_empty() { color } else { format!("repeating-linear-gradient(90deg,{})", stops.join(",")) }
}

/// Text that is safe inside HTML and attributes.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in splat4d::text::shown(text).chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
    }
    out
}

/// Curves over a common x axis; `None` where there is nothing to draw.
pub fn lines(series: &[Series], x_label: &str, unit: &str) -> Option<String> {
    let series: Vec<(usize, &str, Points)> = series
        .iter()
        .enumerate()
        .map(|(i, s)| (i, s.name.as_str(), reduced(&s.points)))
        .filter(|s| !s.2.is_empty())
        .collect();
    let all = || series.iter().flat_map(|s| &s.2);
    let (x0, x1) = range(all().map(|p| p.0))?;
    let (y0, y1) = range(all().map(|p| p.1))?;
    let (x0, x1) = if x1 > x0 { (x0, x1) } else { (x0 - 0.5, x0 + 0.5) };
    let pad = if y1 > y0 { 0.06 * (y1 - y0) } else { y0.abs().max(1.0) * 0.05 };
    let (y0, y1) = (y0 - pad, y1 + pad);
    let px = |x: f64| LEFT + (x - x0) / (x1 - x0) * (WIDTH - LEFT - RIGHT);
    let py = |y: f64| HEIGHT - BOTTOM - (y - y0) / (y1 - y0) * (HEIGHT - TOP - BOTTOM);
    let mut svg = open(HEIGHT, &format!("{unit} over {x_label}"));
    let y_ticks = ticks(y0, y1, 5);
    for (y, label) in y_ticks.iter().zip(labels(&y_ticks)) {
        let v = py(*y);
        let _ = write!(
            svg,
            r#"<line class="grid" x1="{LEFT}" x2="{:.1}" y1="{v:.1}" y2="{v:.1}"/><text class="tick" x="{:.1}" y="{:.1}" text-anchor="end">{}</text>"#,
            WIDTH - RIGHT,
            LEFT - 7.0,
            v + 4.0,
            label
        );
    }
    let x_ticks = ticks(x0, x1, 6);
    for (x, label) in x_ticks.iter().zip(labels(&x_ticks)) {
        let u = px(*x);
        let _ = write!(
            svg,
            r#"<text class="tick" x="{u:.1}" y="{:.1}" text-anchor="middle">{}</text>"#,
            HEIGHT - BOTTOM + 16.0,
            label
        );
    }
    let _ = write!(
        svg,
        r#"<text class="axis" x="{:.1}" y="{:.1}" text-anchor="end">{}</text>"#,
        WIDTH - RIGHT,
        HEIGHT - 3.0,
        escape(x_label)
    );
    for (i, _, points) in &series {
        let mut path = String::new();
        for (k, (x, y)) in points.iter().enumerate() {
            let _ = write!(path, "{}{:.1} {:.1}", if k == 0 { "M" } else { "L" }, px(*x), py(*y));
        }
        let color = i % COLORS;
        let _ = write!(svg, r#"<path class="line" style="stroke:var(--c{color}){}" d="{path}"/>"#, dashes(*i));
        if let [(x, y)] = points.as_slice() {
            let _ =
                write!(svg, r#"<circle style="fill:var(--c{color})" cx="{:.1}" cy="{:.1}" r="3"/>"#, px(*x), py(*y));
        }
    }
    for (i, name, points) in &series {
        let step = points.len().div_ceil(MAX_TIPS);
        for (x, y) in points.iter().step_by(step) {
            let label = if name.is_empty() { String::new() } else { format!("{}: ", escape(name)) };
            let _ = write!(
                svg,
                r#"<circle class="tip" style="fill:var(--c{})" cx="{:.1}" cy="{:.1}" r="5"><title>{label}{} {} at {} {}</title></circle>"#,
                i % COLORS,
                px(*x),
                py(*y),
                short(*y),
                escape(unit),
                short(*x),
                escape(x_label)
            );
        }
    }
    svg.push_str("</svg>");
    let named: Vec<_> = series.iter().filter(|s| !s.1.is_empty()).collect();
    if !named.is_empty() {
        svg.push_str(r#"<div class="legend">"#);
        for (i, name, _) in named {
            let _ = write!(svg, r#"<span><i style="background:{}"></i>{}</span>"#, mark(*i), escape(name));
        }
        svg.push_str("</div>");
    }
    Some(svg)
}

/// The colours of the page's style sheet, for images outside the page.
const STYLE: &str = "svg{--c0:#b4501e;--c1:#2463a8;--c2:#009c90;--c3:#b478f0;--c4:#781800;--c5:#e47818;--c6:#9c00fc;--c7:#243c6c;\
--soft:#6d6a66;--line:#e6e2dc;font-family:sans-serif}@media(prefers-color-scheme:dark){svg{\
--c0:#f08c4e;--c1:#6fb1f2;--c2:#c0f000;--c3:#6c60fc;--c4:#d83c24;--c5:#fcc0a8;--c6:#00f0fc;--c7:#9c6c9c;\
--soft:#a09a92;--line:#35322e}}.grid{stroke:var(--line)}.tick,.axis{fill:var(--soft);font-size:11.5px}\
.line{fill:none;stroke-width:1.8}";

/// Space for a name below the curves of a file; three fit.
const NAME: f64 = 118.0;

/// The same curves as a file of their own, with a mark at every point and the names below.
pub fn file(series: &[Series], x_label: &str, unit: &str) -> Option<String> {
    let page = lines(series, x_label, unit)?;
    let svg = page
        .split_inclusive("</svg>")
        .next()?
        .replace(r#"class="tip""#, r#"class="dot""#)
        .replace(r#"r="5""#, r#"r="3""#);
    let size = format!(r#"<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" "#);
    let svg = svg.replacen("<svg ", &size, 1).replacen('>', &format!("><style>{STYLE}</style>"), 1);
    let mut names = String::new();
    let shown = series.iter().enumerate().filter(|(_, s)| !reduced(&s.points).is_empty());
    for (place, (i, s)) in shown.enumerate() {
        let (x, y) = (LEFT + 34.0 + NAME * place as f64, HEIGHT - 3.0);
        let (color, name) = (i % COLORS, escape(&s.name));
        let _ = write!(names, r#"<text x="{x}" y="{y}" font-size="12" style="fill:var(--c{color})">{name}</text>"#);
    }
    let _ = write!(names, r#"<text class="axis" x="{LEFT}" y="{}">{}</text>"#, HEIGHT - 3.0, escape(unit));
    Some(svg.replace("</svg>", &format!("{names}</svg>")))
}

/// One horizontal bar a row: label, value, and the text next to it. Bars start at `from`.
pub fn bars(rows: &[(String, f64, String)], from: f64, label: &str) -> Option<String> {
    const ROW: f64 = 24.0;
    const LABEL: f64 = 128.0;
    const VALUE: f64 = 112.0; // "20.48 dB (20.59)"
    let highest = rows.iter().map(|r| r.1).filter(|v| v.is_finite()).fold(f64::NEG_INFINITY, f64::max);
    if rows.is_empty() || !highest.is_finite() {
        return None;
    }
    let scale = (WIDTH - LABEL - VALUE) / (highest - from).max(f64::MIN_POSITIVE);
    let mut svg = open(ROW * rows.len() as f64 + 4.0, label);
    for (i, (name, value, text)) in rows.iter().enumerate() {
        let y = ROW * i as f64 + 2.0;
        let length = if value.is_finite() { ((value - from) * scale).max(1.5) } else { 0.0 };
        let _ = write!(
            svg,
            r#"<text class="tick" x="{:.1}" y="{:.1}" text-anchor="end">{}</text><rect class="bar" x="{LABEL}" y="{:.1}" width="{length:.1}" height="{:.1}" rx="3"><title>{} {}</title></rect><text class="value" x="{:.1}" y="{:.1}">{}</text>"#,
            LABEL - 9.0,
            y + 15.5,
            escape(&clipped(name, 18)),
            y + 3.0,
            ROW - 7.0,
            escape(name),
            escape(text),
            LABEL + length + 7.0,
            y + 15.5,
            escape(text)
        );
    }
    svg.push_str("</svg>");
    Some(svg)
}

fn open(height: f64, label: &str) -> String {
    format!(r#"<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{}">"#, escape(label))
}

fn clipped(text: &str, most: usize) -> String {
    if text.chars().count() <= most {
        return text.to_owned();
    }
    text.chars().take(most - 1).chain(['…']).collect()
}

fn range(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let (lo, hi) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)));
    (lo <= hi).then_some((lo, hi))
}

/// Finite points, thinned to means of equal runs.
fn reduced(points: &[(f64, f64)]) -> Points {
    let finite: Points = points.iter().copied().filter(|p| p.0.is_finite() && p.1.is_finite()).collect();
    let run = finite.len().div_ceil(MAX_POINTS).max(1);
    let mean = |c: &[(f64, f64)]| {
        let n = c.len() as f64;
        (c.iter().map(|p| p.0).sum::<f64>() / n, c.iter().map(|p| p.1).sum::<f64>() / n)
    };
    finite.chunks(run).map(mean).collect()
}

/// About `count` round numbers in [lo, hi].
fn ticks(lo: f64, hi: f64, count: usize) -> Vec<f64> {
    let raw = (hi - lo) / count as f64;
    let power = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].iter().map(|m| m * power).find(|s| *s >= raw).unwrap_or(10.0 * power);
    let first = (lo / step).ceil() as i64;
    (first..).map(|i| i as f64 * step).take_while(|v| *v <= hi + 1e-9 * step).take(2 * count + 2).collect()
}

/// Labels of ticks, with as many decimals as their distance needs; thousands and millions are shortened if they stay
/// distinct.
fn labels(ticks: &[f64]) -> Vec<String> {
    let shortened: Vec<String> = ticks.iter().copied().map(short).collect();
    let step = ticks.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
    let distinct = shortened.windows(2).all(|pair| pair[0] != pair[1]);
    if !step.is_finite() || distinct && ticks.iter().any(|v| v.abs() >= SHORTENED) {
        return shortened;
    }
    // A step of 0.1 may be a little less than that.
    let digits = -(step.log10() + 1e-9).floor();
    let digits = digits.clamp(0.0, MOST_DECIMALS) as usize;
    ticks.iter().map(|v| format!("{v:.digits$}")).collect()
}

/// From here on numbers are written in thousands.
const SHORTENED: f64 = 1e4;
/// Decimals of a tick's label: more do not fit next to the axis.
const MOST_DECIMALS: f64 = 6.0;

/// A number as people write it on an axis.
pub fn short(v: f64) -> String {
    let a = v.abs();
    let text = match a {
        _ if a >= 1e6 => format!("{:.1}M", v / 1e6),
        _ if a >= SHORTENED => format!("{:.0}k", v / 1e3),
        _ if a >= 100.0 => format!("{v:.0}"),
        _ if a >= 10.0 => format!("{v:.1}"),
        _ if a >= 0.1 || v == 0.0 => format!("{v:.2}"),
        _ => format!("{v:.4}"),
    };
    if text.contains('.') && !text.ends_with(['M', 'k']) {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks(0.0, 10.0, 5), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        assert!(ticks(21.37, 21.52, 5).iter().all(|t| (21.37..=21.53).contains(t)));
        assert_eq!(labels(&[17.65, 17.7, 17.75]), ["17.65", "17.70", "17.75"], "no two ticks have one label");
        assert_eq!(labels(&[14.0, 14.2, 14.4]), ["14.0", "14.2", "14.4"]);
        assert_eq!(labels(&[12_000.0, 12_500.0]), ["12000", "12500"]);
        assert_eq!(labels(&[10_000.0, 20_000.0]), ["10k", "20k"]);
        assert_eq!((short(30_000.0), short(0.25), short(31.0)), ("30k".into(), "0.25".into(), "31".into()));
    }

    #[test]
    fn charts_accept_empty_and_invalid_series() {
        let series = |points: Vec<(f64, f64)>| [Series { name: "a<b".into(), points }];
        assert!(lines(&series(vec![]), "step", "dB").is_none());
        assert!(lines(&series(vec![(1.0, f64::NAN)]), "step", "dB").is_none());
        let one = lines(&series(vec![(1.0, 3.0)]), "step", "dB").unwrap();
        assert!(one.contains("<circle") && one.contains("a&lt;b") && !one.contains("NaN"));
        let many = lines(&series((0..100_000).map(|i| (f64::from(i), 1.0)).collect()), "step", "dB").unwrap();
        assert!(many.len() < 40_000, "a long run stays small: {}", many.len());
        assert!(bars(&[], 0.0, "x").is_none());
        assert!(!bars(&[("cam".into(), 3.0, "3 dB".into())], 3.0, "x").unwrap().contains("NaN"));
    }

    #[test]
    fn many_curves_differ_in_colour_or_dashes() {
        let many = COLORS * DASHES.len();
        let series: Vec<Series> =
            (0..many).map(|i| Series { name: i.to_string(), points: vec![(0.0, 1.0), (1.0, i as f64)] }).collect();
        let svg = lines(&series, "step", "dB").unwrap();
        let looks = |start: &str| {
            let found: Vec<&str> = svg.split(start).skip(1).map(|rest| rest.split('"').next().unwrap()).collect();
            assert_eq!(found.len(), many, "{start}");
            found.into_iter().collect::<std::collections::BTreeSet<_>>().len()
        };
        assert_eq!(looks(r#"class="line" style=""#), many, "no two curves look the same");
        assert_eq!(looks(r#"<i style="background:"#), many, "nor do two marks of the legend");
    }

    /// Colours of a style sheet, sRGB: those on a light page, then those on a dark one.
    fn palettes(sheet: &str) -> [Vec<[f64; 3]>; 2] {
        let numbered = |rest: &&str| rest.starts_with(|c: char| c.is_ascii_digit()) && rest[1..].starts_with(':');
        let mut found = sheet.split("--c").skip(1).filter(numbered).map(|rest| {
            let hex = rest.split('#').nth(1).unwrap();
            [0, 2, 4].map(|k| f64::from(u8::from_str_radix(&hex[k..k + 2], 16).unwrap()) / 255.0)
        });
        let light: Vec<_> = found.by_ref().take(COLORS).collect();
        let dark: Vec<_> = found.by_ref().take(COLORS).collect();
        assert!(dark.len() == COLORS && found.next().is_none());
        [light, dark]
    }

    #[test]
    fn colours_differ_for_the_colour_blind_too() {
        type Matrix = [[f64; 3]; 3];
        // Machado, Oliveira, Fernandes 2009, severity 1.
        const SIGHT: [Matrix; 4] = [
            [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
            [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
            [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
        ];
        // OKLab: Ottosson 2020.
        const CONES: Matrix = [
            [0.4122214708, 0.5363325363, 0.0514459929],
            [0.2119034982, 0.6806995451, 0.1073969566],
            [0.0883024619, 0.2817188376, 0.6299787005],
        ];
        const LAB: Matrix = [
            [0.2104542553, 0.7936177850, -0.0040720468],
            [1.9779984951, -2.4285922050, 0.4505937099],
            [0.0259040371, 0.7827717662, -0.8086757660],
        ];
        let times = |m: &Matrix, v: [f64; 3]| m.map(|row| (0..3).map(|k| row[k] * v[k]).sum::<f64>());
        let linear = |c: f64| if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
        let luminance = |c: [f64; 3]| 0.2126 * linear(c[0]) + 0.7152 * linear(c[1]) + 0.0722 * linear(c[2]);
        let (page, file) = (palettes(include_str!("style.css")), palettes(STYLE));
        assert_eq!(page, file, "images outside the page have its colours");
        for (colors, card) in page.into_iter().zip([[1.0; 3], [32.0 / 255.0, 31.0 / 255.0, 29.0 / 255.0]]) {
            for (i, a) in colors.iter().enumerate() {
                let (a_light, b_light) = (luminance(*a) + 0.05, luminance(card) + 0.05);
                let contrast = a_light.max(b_light) / a_light.min(b_light);
                assert!(contrast >= 3.0, "colour {i}: {contrast:.2}");
                for (j, b) in colors.iter().enumerate().take(i) {
                    for sight in &SIGHT {
                        let lab = |c: [f64; 3]| {
                            let seen = times(sight, c.map(linear)).map(|v| v.clamp(0.0, 1.0));
                            times(&LAB, times(&CONES, seen).map(f64::cbrt))
                        };
                        let (a, b) = (lab(*a), lab(*b));
                        let apart = (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt();
                        assert!(apart >= 0.12, "colours {i} and {j}: {apart:.3}");
                    }
                }
            }
        }
    }
}

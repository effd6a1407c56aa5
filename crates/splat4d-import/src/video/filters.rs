//! The chain of ffmpeg's filters that makes frames of a video: times, choice, colours, size.

use super::{Color, Info, Range, Selection, Transfer};

/// How ffmpeg scales and turns colours: bicubic, without the shortcuts that it takes for speed.
const SCALING: &str = "bicubic+accurate_rnd+full_chroma_int+full_chroma_inp";
/// Light of white, cd/m², that ordinary screens are graded for (BT.1886): what tone mapping refers to.
const WHITE: u32 = 100;

/// A chain and the message about it.
#[derive(Debug, PartialEq)]
pub(super) struct Chain {
    /// As `-vf` takes it.
    pub text: String,
    /// Size of the output frames.
    pub size: [usize; 2],
    /// A sentence each.
    pub warnings: Vec<String>,
}

/// The chain for a video. `showinfo@all` prints the times of all frames, `showinfo@kept` those of the chosen ones.
pub(super) fn chain(info: &Info, selection: &Selection, tone_mapping: bool) -> Chain {
    let size = selection.scaled(info.size);
    let mut parts: Vec<String> = Vec::new();
    let mut warnings = Vec::new();
    if info.interlaced {
        // One frame for two fields, as many as before; frames that are whole are left alone.
        parts.push("yadif=mode=send_frame:deint=interlaced".into());
    }
    parts.push("showinfo@all=checksum=0".into());
    if selection.every > 1 {
        parts.push(format!("select=not(mod(n\\,{}))", selection.every));
    }
    parts.push("showinfo@kept=checksum=0".into());
    let mut color = info.color;
    if color.transfer != Transfer::Standard {
        let kind = if color.transfer == Transfer::Hlg { "HLG" } else { "PQ" };
        if tone_mapping {
            warnings.push(format!(
                "It has a high dynamic range ({kind}), which is mapped to the ordinary one: let all cameras do the same, or \
                 switch it off in the camera."
            ));
            parts.extend(tone_map(&color));
            color = Color { matrix: Some("bt709"), tagged: true, range: Range::Full, transfer: Transfer::Standard };
        } else {
            warnings.push(format!(
                "It has a high dynamic range ({kind}), and this ffmpeg cannot map it to the ordinary one (it lacks zscale): \
                 its colours will be pale. Install a full ffmpeg, or switch it off in the camera."
            ));
        }
    }
    if !color.tagged
        && let Some(matrix) = color.matrix
    {
        warnings.push(format!("Its file does not state its colour matrix; assumed: {} by its size.", said(matrix)));
    }
    if let Some(crop) = selection.crop {
        if info.upright_stored() != info.size {
            // Crops are given in square pixels.
            parts.push(format!("scale={}:{}:flags={SCALING}", info.size[0], info.size[1]));
        }
        parts.push(format!("crop={}:{}:{}:{}:exact=1", crop.width, crop.height, crop.x, crop.y));
    }
    let range = if color.range == Range::Full { "full" } else { "limited" };
    let matrix = color.matrix.map(|m| format!(":in_color_matrix={m}:in_range={range}")).unwrap_or_default();
    parts.push(format!("scale={}:{}:flags={SCALING}{matrix}", size[0], size[1]));
    parts.push(if info.alpha { "format=rgba" } else { "format=rgb24" }.into());
    Chain { text: parts.join(","), size, warnings }
}

/// High dynamic range to what ordinary screens show: light, other primaries, Hable's curve, and back.
fn tone_map(color: &Color) -> [String; 5] {
    let transfer = if color.transfer == Transfer::Hlg { "arib-std-b67" } else { "smpte2084" };
    let matrix = if color.matrix == Some("bt709") { "bt709" } else { "bt2020nc" };
    let range = if color.range == Range::Full { "full" } else { "limited" };
    [
        format!("zscale=tin={transfer}:min={matrix}:pin=bt2020:rin={range}:t=linear:npl={WHITE}"),
        "format=gbrpf32le".into(),
        "zscale=p=bt709".into(),
        "tonemap=tonemap=hable:desat=0".into(),
        "zscale=t=bt709:m=bt709:r=full,format=yuv444p".into(),
    ]
}

/// The usual name of a matrix.
fn said(matrix: &str) -> &str {
    match matrix {
        "bt709" => "BT.709",
        "bt601" => "BT.601",
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn info() -> Info {
        let color = Color { matrix: Some("bt709"), tagged: true, range: Range::Limited, transfer: Transfer::Standard };
        Info {
            name: "a".into(),
            size: [1920, 1080],
            stored: [1920, 1080],
            rotation: 0,
            nominal_rate: Some(30.0),
            average_rate: Some(30.0),
            time_base: None,
            duration: None,
            frames: None,
            codec: "h264".into(),
            pixels: "yuv420p".into(),
            interlaced: false,
            color,
            sound: false,
            alpha: false,
            warnings: Vec::new(),
        }
    }

    #[test]
    fn frame_times_are_read_before_and_after_selection() {
        let selection = Selection { every: 3, size: Some(540), ..Selection::default() };
        let chain = chain(&info(), &selection, true);
        assert_eq!(chain.size, [960, 540]);
        let at = |word: &str| chain.text.find(word).unwrap_or_else(|| panic!("{word}: {}", chain.text));
        assert!(at("showinfo@all") < at("select=not(mod(n\\,3))") && at("select") < at("showinfo@kept"));
        assert!(chain.text.contains("scale=960:540") && chain.text.contains("in_color_matrix=bt709:in_range=limited"));
        assert!(chain.warnings.is_empty());
    }

    #[test]
    fn images_are_cropped_before_they_are_scaled() {
        let crop = Some(crate::video::Crop { width: 1920, height: 800, x: 0, y: 140 });
        let chain = chain(&info(), &Selection { crop, size: Some(400), ..Selection::default() }, true);
        assert_eq!(chain.size, [960, 400]);
        let at = |word: &str| chain.text.find(word).unwrap_or_else(|| panic!("{word}: {}", chain.text));
        assert!(at("crop=1920:800:0:140") < at("scale=960:400"));
    }

    #[test]
    fn a_high_dynamic_range_is_mapped_or_reported() {
        let mut hlg = info();
        hlg.color.transfer = Transfer::Hlg;
        let with = chain(&hlg, &Selection::default(), true);
        assert!(with.text.contains("tin=arib-std-b67") && with.text.contains("in_range=full"));
        assert!(with.warnings[0].contains("HLG"));
        let without = chain(&hlg, &Selection::default(), false);
        assert!(!without.text.contains("zscale") && without.warnings[0].contains("zscale"));
    }

    #[test]
    fn guesses_are_reported_and_rgb_needs_none() {
        let mut guessed = info();
        guessed.color.tagged = false;
        assert!(chain(&guessed, &Selection::default(), true).warnings[0].contains("BT.709"));
        let mut rgb = info();
        rgb.color.matrix = None;
        assert!(!chain(&rgb, &Selection::default(), true).text.contains("in_color_matrix"));
    }
}

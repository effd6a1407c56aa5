//! Properties of a video from ffprobe.

use super::program::ratio;
use serde_json::Value;
use splat4d::{Error, ErrorKind, Result};

/// Lines from which on an untagged video is taken for high definition, and its colours for BT.709 (as players do);
/// below they are BT.601.
const HD_LINES: usize = 720;
/// Pixels across from which on it is, for wide images of fewer lines.
const HD_COLUMNS: usize = 1280;

/// Which part of the numbers carries the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Range {
    /// 0 to 255.
    Full,
    /// 16 to 235.
    Limited,
}

/// How light becomes a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transfer {
    /// As ordinary screens expect it.
    Standard,
    /// High dynamic range, hybrid log-gamma (BT.2100).
    Hlg,
    /// High dynamic range, perceptual quantiser (BT.2100).
    Pq,
}

/// Colour interpretation of a video.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Color {
    /// The matrix from luma and chroma to RGB, as ffmpeg names it; None: the file holds RGB or grey.
    pub matrix: Option<&'static str>,
    /// Whether the matrix is stated, and not guessed from the size.
    pub tagged: bool,
    /// Full or limited.
    pub range: Range,
    /// Ordinary or high dynamic range.
    pub transfer: Transfer,
}

impl Info {
    /// Pixels across and down of stored images after they were turned upright.
    pub(super) fn upright_stored(&self) -> [usize; 2] {
        let [w, h] = self.stored;
        if self.rotation.rem_euclid(180) == 90 { [h, w] } else { [w, h] }
    }
}

/// Properties of a source.
#[derive(Clone, Debug, PartialEq)]
pub struct Info {
    /// A name for its camera: the file's or folder's, without an ending.
    pub name: String,
    /// Pixels across and down of its frames: upright, square pixels.
    pub size: [usize; 2],
    /// Pixels across and down as stored.
    pub stored: [usize; 2],
    /// Degrees by which stored images are turned clockwise.
    pub rotation: i32,
    /// Frames per second that the file is made for.
    pub nominal_rate: Option<f64>,
    /// Frames over seconds.
    pub average_rate: Option<f64>,
    /// Seconds that a time stamp counts.
    pub time_base: Option<f64>,
    /// Seconds.
    pub duration: Option<f64>,
    /// Frames, where the file states them.
    pub frames: Option<usize>,
    /// The codec, as ffmpeg names it.
    pub codec: String,
    /// The pixel format, as ffmpeg names it.
    pub pixels: String,
    /// Whether a frame is two half images of different times.
    pub interlaced: bool,
    /// Colour interpretation.
    pub color: Color,
    /// Whether there is sound.
    pub sound: bool,
    /// Whether pixels may be transparent.
    pub alpha: bool,
    /// Assumptions and remarks, a sentence each.
    pub warnings: Vec<String>,
}

/// Result of a probe, and its path.
#[derive(Debug)]
pub(super) struct Probe {
    pub info: Info,
    /// Number of the image stream.
    pub picture: usize,
    /// Number of the sound stream.
    pub sound: Option<usize>,
    /// Whether the duration is that of the image stream, and not of the longest one.
    pub own_duration: bool,
    /// The decoder that gives alpha, where the usual one leaves it out (VP8 and VP9 store it in packets of its own).
    pub alpha_decoder: Option<&'static str>,
}

/// Understands what ffprobe wrote. Errors: no image stream, no codec that is known, no size.
pub(super) fn parse(json: &str, name: String) -> Result<Probe> {
    let top: Value = serde_json::from_str(json)
        .map_err(|e| Error::input(format!("the output of ffprobe cannot be parsed ({e})")).remedy("Update ffmpeg."))?;
    let streams = top["streams"].as_array().map_or(&[][..], Vec::as_slice);
    let of = |kind: &'static str| streams.iter().filter(move |s| s["codec_type"] == kind);
    // The cover of a song is a stream of one image.
    let films = || of("video").filter(|s| s["disposition"]["attached_pic"] != 1);
    let film = films().find(|s| s["disposition"]["default"] == 1).or_else(|| films().next());
    let Some(film) = film else {
        let what = if of("audio").next().is_some() { "there is sound, but no images" } else { "there are no images" };
        return Err(Error::input(what).remedy("Give the file that the camera wrote, or take it out."));
    };
    let text = |key: &str| film[key].as_str().unwrap_or("");
    let codec = text("codec_name").to_owned();
    if codec.is_empty() || codec == "unknown" || codec == "none" {
        let what = format!("ffmpeg does not support its codec ({})", text("codec_tag_string"));
        return Err(Error::new(ErrorKind::Unsupported, what)
            .remedy("Convert it with the camera maker's program to H.264 in mp4."));
    }
    let side = |key: &str| film[key].as_u64().filter(|s| *s > 0).map(|s| s as usize);
    let (Some(width), Some(height)) = (side("width"), side("height")) else {
        return Err(Error::input(format!("its images ({codec}) have no size: the beginning of the file is damaged"))
            .remedy("Copy it again from the camera."));
    };
    let mut warnings = Vec::new();
    let rotation = rotation(film);
    if rotation % 90 != 0 {
        warnings.push(format!("It is turned by {rotation} degrees, which leaves black corners."));
    }
    // Pixels that are not square are made so.
    let aspect = ratio(text("sample_aspect_ratio")).unwrap_or(1.0);
    let (wide, high) = (((width as f64 * aspect).round() as usize).max(1), height);
    let size = if rotation % 180 == 90 { [high, wide] } else { [wide, high] };
    let number = |v: &Value| v.as_str().and_then(|s| s.parse::<f64>().ok()).filter(|d| d.is_finite() && *d > 0.0);
    let own = number(&film["duration"]).or_else(|| film["tags"]["DURATION"].as_str().and_then(clock_time));
    let pixels = text("pix_fmt").to_owned();
    let color = color(film, &codec, &pixels, [width, height]);
    // Matroska's mark for alpha next to the images.
    let beside = ["alpha_mode", "ALPHA_MODE"].iter().any(|tag| film["tags"][*tag] == "1");
    let alpha_decoder = match codec.as_str() {
        "vp8" if beside => Some("libvpx"),
        "vp9" if beside => Some("libvpx-vp9"),
        _ => None,
    };
    let nominal_rate = ratio(text("r_frame_rate"));
    let average_rate = ratio(text("avg_frame_rate"));
    let info = Info {
        name,
        size,
        stored: [width, height],
        rotation,
        nominal_rate,
        average_rate,
        time_base: ratio(text("time_base")),
        duration: own.or_else(|| number(&top["format"]["duration"])),
        frames: film["nb_frames"].as_str().and_then(|n| n.parse().ok()),
        codec,
        pixels,
        interlaced: matches!(text("field_order"), "tt" | "bb" | "tb" | "bt"),
        color,
        sound: of("audio").next().is_some(),
        alpha: has_alpha(&text("pix_fmt").to_ascii_lowercase()) || alpha_decoder.is_some(),
        warnings,
    };
    let index = |s: &Value| s["index"].as_u64().unwrap_or(0) as usize;
    let sound = of("audio").next().map(index);
    Ok(Probe { info, picture: index(film), sound, own_duration: own.is_some(), alpha_decoder })
}

/// Whether a pixel format, as ffmpeg names it, has alpha.
fn has_alpha(pixels: &str) -> bool {
    let begins = ["rgba", "bgra", "argb", "abgr", "gbrap", "ya8", "ya16", "ayuv", "vuya"];
    pixels.starts_with("yuva") || begins.iter().any(|b| pixels.starts_with(b))
}

/// Degrees clockwise, 0 to 359. The matrix in the side data turns the other way; older versions have a tag.
fn rotation(film: &Value) -> i32 {
    let matrix = film["side_data_list"].as_array().and_then(|l| l.iter().find_map(|d| d["rotation"].as_f64()));
    let tag = || film["tags"]["rotate"].as_str().and_then(|t| t.parse::<f64>().ok());
    let degrees = matrix.map(|r| -r).or_else(tag).unwrap_or(0.0);
    (degrees.round() as i32).rem_euclid(360)
}

fn color(film: &Value, codec: &str, pixels: &str, [width, height]: [usize; 2]) -> Color {
    let text = |key: &str| film[key].as_str().unwrap_or("");
    let told = match text("color_space") {
        "bt709" => Some("bt709"),
        "smpte170m" => Some("smpte170m"),
        "bt470bg" => Some("bt470bg"),
        "smpte240m" => Some("smpte240m"),
        "fcc" => Some("fcc"),
        "bt2020nc" | "bt2020c" => Some("bt2020"),
        _ => None,
    };
    let no_matrix =
        ["rgb", "bgr", "gbr", "argb", "abgr", "0rgb", "0bgr", "gray", "pal", "mono", "bayer", "x2rgb", "x2bgr"]
            .iter()
            .any(|p| pixels.starts_with(p));
    // Motion JPEG is JPEG: BT.601 in the full range, whatever its size.
    let jpeg = codec == "mjpeg" || pixels.starts_with("yuvj");
    let large = height.min(width) >= HD_LINES || width.max(height) >= HD_COLUMNS;
    let guessed = if codec == "mjpeg" || !large { "bt601" } else { "bt709" };
    let range = match text("color_range") {
        "pc" => Range::Full,
        "tv" => Range::Limited,
        _ if jpeg || no_matrix => Range::Full,
        _ => Range::Limited,
    };
    let transfer = match text("color_transfer") {
        "arib-std-b67" => Transfer::Hlg,
        "smpte2084" => Transfer::Pq,
        _ => Transfer::Standard,
    };
    Color {
        matrix: (!no_matrix).then(|| told.unwrap_or(guessed)),
        tagged: told.is_some() || no_matrix || codec == "mjpeg",
        range,
        transfer,
    }
}

/// "00:01:02.500000000" in seconds.
fn clock_time(text: &str) -> Option<f64> {
    let mut parts = text.split(':').map(|p| p.trim().parse::<f64>().ok());
    let (hours, minutes, seconds) = (parts.next()??, parts.next()??, parts.next()??);
    Some(hours * 3600.0 + minutes * 60.0 + seconds).filter(|s| *s > 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// Output for a phone's video, with `change`.
    fn phone(change: impl FnOnce(&mut Value)) -> Value {
        let mut film = json!({
            "index": 0, "codec_type": "video", "codec_name": "hevc", "width": 1920, "height": 1080,
            "sample_aspect_ratio": "1:1", "pix_fmt": "yuv420p", "field_order": "progressive",
            "r_frame_rate": "30/1", "avg_frame_rate": "27000/901", "time_base": "1/600", "duration": "9.010000",
            "nb_frames": "270", "color_range": "tv", "color_space": "bt709", "color_transfer": "bt709",
            "disposition": {"default": 1, "attached_pic": 0},
            "side_data_list": [{"side_data_type": "Display Matrix", "rotation": -90}]
        });
        change(&mut film);
        film
    }

    fn probe(streams: &[Value]) -> Result<Probe> {
        parse(&json!({"streams": streams, "format": {"duration": "9.5"}}).to_string(), "a".into())
    }

    #[test]
    fn a_rotated_phone_video_is_probed() {
        let sound = json!({"index": 1, "codec_type": "audio", "codec_name": "aac"});
        let found = probe(&[phone(|_| ()), sound]).unwrap();
        let info = &found.info;
        assert_eq!((info.size, info.stored, info.rotation), ([1080, 1920], [1920, 1080], 90));
        assert_eq!((found.picture, found.sound, info.frames, info.interlaced), (0, Some(1), Some(270), false));
        assert_eq!((info.nominal_rate, info.time_base, info.duration), (Some(30.0), Some(1.0 / 600.0), Some(9.01)));
        let expected =
            Color { matrix: Some("bt709"), tagged: true, range: Range::Limited, transfer: Transfer::Standard };
        assert_eq!(info.color, expected);
        // Older versions of ffmpeg state the rotation in a tag, clockwise.
        let old = phone(|f| {
            f.as_object_mut().unwrap().remove("side_data_list");
            f["tags"] = json!({"rotate": "270"});
        });
        assert_eq!(probe(&[old]).unwrap().info.rotation, 270);
    }

    #[test]
    fn default_colours_follow_from_the_size() {
        let matrix = |width: usize, height: usize, codec: &str, pixels: &str| {
            let film = phone(|f| {
                for key in ["color_space", "color_range"] {
                    f.as_object_mut().unwrap().remove(key);
                }
                (f["width"], f["height"]) = (json!(width), json!(height));
                (f["codec_name"], f["pix_fmt"]) = (json!(codec), json!(pixels));
            });
            let color = probe(&[film]).unwrap().info.color;
            (color.matrix, color.range, color.tagged)
        };
        assert_eq!(matrix(1920, 1080, "h264", "yuv420p"), (Some("bt709"), Range::Limited, false));
        assert_eq!(matrix(720, 576, "h264", "yuv420p"), (Some("bt601"), Range::Limited, false));
        assert_eq!(matrix(1920, 1080, "mjpeg", "yuvj422p"), (Some("bt601"), Range::Full, true));
        assert_eq!(matrix(1920, 1080, "h264", "yuvj420p"), (Some("bt709"), Range::Full, false));
        assert_eq!(matrix(1920, 1080, "ffv1", "gbrp"), (None, Range::Full, true));
    }

    #[test]
    fn high_dynamic_range_and_interlace_are_detected() {
        let hlg = phone(|f| {
            f["color_transfer"] = json!("arib-std-b67");
            f["color_space"] = json!("bt2020nc");
        });
        let color = probe(&[hlg]).unwrap().info.color;
        assert_eq!((color.transfer, color.matrix), (Transfer::Hlg, Some("bt2020")));
        let pq = phone(|f| f["color_transfer"] = json!("smpte2084"));
        assert_eq!(probe(&[pq]).unwrap().info.color.transfer, Transfer::Pq);
        for (order, interlaced) in [("tt", true), ("bt", true), ("progressive", false), ("unknown", false)] {
            let film = phone(|f| f["field_order"] = json!(order));
            assert_eq!(probe(&[film]).unwrap().info.interlaced, interlaced, "{order}");
        }
    }

    #[test]
    fn alpha_is_detected_by_format_and_flag() {
        let of = |codec: &str, pixels: &str, mark: bool| {
            let film = phone(|f| {
                (f["codec_name"], f["pix_fmt"]) = (json!(codec), json!(pixels));
                if mark {
                    f["tags"] = json!({"alpha_mode": "1"});
                }
            });
            let found = probe(&[film]).unwrap();
            (found.info.alpha, found.alpha_decoder)
        };
        assert_eq!(of("prores", "yuva444p12le", false), (true, None));
        assert_eq!(of("qtrle", "argb", false), (true, None));
        assert_eq!(of("vp9", "yuv420p", true), (true, Some("libvpx-vp9")));
        assert_eq!(of("vp9", "yuv420p", false), (false, None));
        assert_eq!(of("hevc", "gbrp", false), (false, None));
    }

    #[test]
    fn non_square_pixels_and_other_durations_are_read() {
        let film = phone(|f| {
            (f["width"], f["height"], f["sample_aspect_ratio"]) = (json!(1440), json!(1080), json!("4:3"));
            f.as_object_mut().unwrap().remove("side_data_list");
            f.as_object_mut().unwrap().remove("duration");
            f["tags"] = json!({"DURATION": "00:01:02.500000000"});
        });
        let found = probe(&[film]).unwrap();
        assert_eq!((found.info.size, found.info.duration, found.own_duration), ([1920, 1080], Some(62.5), true));
        let film = phone(|f| drop(f.as_object_mut().unwrap().remove("duration")));
        let found = probe(&[film]).unwrap();
        assert_eq!((found.info.duration, found.own_duration), (Some(9.5), false));
    }

    #[test]
    fn unusable_videos_are_refused_with_a_reason() {
        let cover = phone(|f| f["disposition"]["attached_pic"] = json!(1));
        let sound = json!({"index": 1, "codec_type": "audio", "codec_name": "aac"});
        for (streams, word) in [
            (vec![], "no images"),
            (vec![cover, sound], "sound, but no images"),
            (vec![phone(|f| f["codec_name"] = json!("unknown"))], "codec"),
            (vec![phone(|f| f["width"] = json!(0))], "no size"),
        ] {
            let error = probe(&streams).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
        assert!(parse("{", "a".into()).unwrap_err().to_string().contains("ffprobe"));
        assert!(parse("[]", "a".into()).is_err());
    }
}

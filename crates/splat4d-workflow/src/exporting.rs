//! A scene as files for others to open: one time as a 3DGS .ply, the whole as a page with its player.

use crate::events::Listener;
use crate::files;
use crate::playable::Playable;
use crate::run_folder::Run;
use crate::source::keep;
use splat4d::layers::{Scene, freeze};
use splat4d::scene::Time;
use splat4d::{Error, Result, format};
use splat4d_serve::{Page, SceneIn};
use std::path::{Path, PathBuf};

/// Writes the Gaussians alive at a time, seconds of the scene, as a 3DGS .ply; returns how many. `world`: in the capture's world,
/// in double precision.
pub fn moment(scene: &Scene<f32>, time: f64, world: bool, out: &Path) -> Result<usize> {
    let params = freeze(scene, Time(time))?;
    let mut bytes = Vec::new();
    format::ply::write_placed(&params, (scene.offset, world), &mut bytes)?;
    files::write(out, &bytes)?;
    Ok(params.len())
}

/// Says that a file of one time is empty, where it is.
pub fn warn_of_empty(scene: &Scene<f32>, time: f64, count: usize, listener: &dyn Listener) {
    if count == 0 {
        listener.warn(&format!(
            "no Gaussian is active at {time} s: the file is empty. The scene lasts from {} to {} s.",
            scene.clip[0], scene.clip[1]
        ));
    }
}

/// Writes the whole scene as one page with its player; with `link` the scene is a file of its own, for web servers.
pub fn page(path: &Path, out: &Path, link: Option<&Path>, listener: &dyn Listener) -> Result<()> {
    if !["html", "htm"].iter().any(|e| out.extension().is_some_and(|own| own.eq_ignore_ascii_case(e)))
        && !out.starts_with("/dev")
    {
        return Err(Error::input("a page's name ends in .html").at(out.display()).remedy("Use -o NAME.html."));
    }
    let run = Run::is(path).then(|| Run::open(path)).transpose()?;
    keep(path, run.as_ref(), out, &[])?;
    if let Some(link) = link.filter(|link| !files::is_playback(link)) {
        return Err(Error::input("the name does not end in .s4d").at(link.display()).remedy("Use --link NAME.s4d."));
    }
    // A playback file may lie next to its page as it is.
    let is_read = |link: &&Path| link.canonicalize().ok().is_some_and(|l| path.canonicalize().is_ok_and(|p| p == l));
    if let Some(link) = link.filter(|link| !is_read(link)) {
        keep(path, run.as_ref(), link, &[])?;
    }
    let address = link.map(|link| address(link, out)).transpose()?;
    let scene = Playable::open(path, listener)?;
    let bytes = scene.bytes()?;
    let inside = SceneIn::Inside(&bytes);
    let html = Page { title: &scene.title, scene: address.as_deref().map_or(inside, SceneIn::Linked) }.html()?;
    if let Some(link) = link {
        files::write(link, &bytes)?;
        listener.written(link);
    }
    files::write(out, html.as_bytes())?;
    listener.say(&format!("a page of {}", files::human_bytes(html.len() as u64)));
    listener.written(out);
    if link.is_some() {
        listener.say("put both on a web server: browsers do not let a page opened from disk read another file");
    }
    Ok(())
}

/// How the page names the file: relative to its own folder, percent-encoded.
fn address(link: &Path, page: &Path) -> Result<String> {
    let folder = |path: &Path| -> Result<PathBuf> {
        let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::canonicalize(parent).map_err(|e| files::cannot_write(path, e))
    };
    let (at, below) = (folder(page)?, folder(link)?);
    let (Ok(below), Some(name)) = (below.strip_prefix(&at), link.file_name()) else {
        return Err(Error::input("is not in the page's folder")
            .at(link.display())
            .remedy("Give --link a file in the page's folder or below it."));
    };
    let parts = below.iter().chain([name]).map(|part| percent(&part.to_string_lossy()));
    Ok(format!("./{}", parts.collect::<Vec<_>>().join("/")))
}

/// A part of an address (RFC 3986): everything but unreserved characters as bytes in hexadecimal.
fn percent(text: &str) -> String {
    let one = |b: u8| {
        let plain = b.is_ascii_alphanumeric() || b"-._~".contains(&b);
        if plain { char::from(b).to_string() } else { format!("%{b:02X}") }
    };
    text.bytes().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_names_its_scene_from_where_it_lies() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("a b")).unwrap();
        let at = |name: &str| folder.path().join(name);
        assert_eq!(address(&at("x.s4d"), &at("page.html")).unwrap(), "./x.s4d");
        assert_eq!(address(&at("a b/ü#?.s4d"), &at("page.html")).unwrap(), "./a%20b/%C3%BC%23%3F.s4d");
        assert!(address(&at("x.s4d"), &at("a b/page.html")).is_err(), "browsers would ask above the page");
        assert!(address(&at("none/x.s4d"), &at("page.html")).is_err());
    }
}

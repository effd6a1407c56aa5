//! `capture`: which of the sample captures to render.

use crate::capture::{self, CAMERAS};
use crate::scene::FRAMES;
use crate::{film, long, photos, still, videos, world};
use anyhow::{Context, Result, bail};
use std::path::Path;

/// `capture [FOLDER]`, `capture --truth FOLDER`, `capture --check [N]`, `capture --still CHARACTER.glb FOLDER ...`, `capture --videos FOLDER`,
/// `capture --world NAME FOLDER`, `capture --long SECONDS FOLDER [--size WxH] [--cameras N] [--scene hall|yard]`,
/// `capture --photos VIEWS FOLDER [--size WxH]` and `capture --film FAULTS FOLDER [--size WxH]`.
pub(crate) fn command(arguments: &[String]) -> Result<()> {
    let home = capture::bundled_folder();
    match arguments {
        [flag, rest @ ..] if flag == "--check" => {
            let count = match rest {
                [] => 3,
                [n] => n.parse().with_context(|| format!("{n} is not a number of images"))?,
                _ => bail!("capture --check takes one number"),
            };
            let clock = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH)?.subsec_nanos();
            let picks = (0..count).map(|i| (u64::from(clock) + 7919 * i) as usize % (CAMERAS * FRAMES));
            capture::check(&home, &picks.map(|p| (p % CAMERAS, p / CAMERAS)).collect::<Vec<_>>())
        }
        [flag, rest @ ..] if flag == "--still" => still::command(rest),
        [flag, name, folder] if flag == "--world" => world::command(name, Path::new(folder), false),
        [flag, name, truth, folder] if flag == "--world" && truth == "--truth" => {
            world::command(name, Path::new(folder), true)
        }
        [flag, folder] if flag == "--truth" && !folder.starts_with('-') => {
            capture::write(&home, Path::new(folder), true)
        }
        [flag, seconds, folder, options @ ..] if flag == "--long" => long::command(seconds, Path::new(folder), options),
        [flag, views, folder, options @ ..] if flag == "--photos" => photos::command(views, Path::new(folder), options),
        [flag, faults, folder, options @ ..] if flag == "--film" => film::command(faults, Path::new(folder), options),
        [flag, folder] if flag == "--videos" => videos::command(Path::new(folder)),
        [] => capture::write(&home, &home, false),
        [folder] if !folder.starts_with('-') => capture::write(&home, Path::new(folder), false),
        _ => bail!(
            "capture takes a folder, --truth with a folder, --check with a number, --still with a character and a folder, --videos with a folder, --world with a name, --truth if it is needed, and a folder, --long with seconds and a folder, --film with faults and a folder, or --photos with a number and a folder"
        ),
    }
}

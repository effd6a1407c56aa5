//! Images of the capture's cameras, for pages that show them next to the render and in camera frusta.

use std::fmt;
use std::sync::Arc;

/// Name of the route: `?view=N&t=SECONDS&side=PIXELS`.
pub(crate) const ROUTE: &str = "photo";
/// The header with the second of the image that was found.
pub(crate) const TIME: &str = "x-splat4d-time";
/// Longest side of an image, pixels: more than a page shows next to a render.
const MOST_SIDE: usize = 2048;

/// One image.
#[derive(Clone, Debug)]
pub struct Photo {
    /// A JPEG file.
    pub jpeg: Vec<u8>,
    /// Its second on the scene's clock.
    pub time: f64,
}

/// A page's request for an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotoQuery {
    /// Number of the camera in the list that the page has.
    pub view: usize,
    /// Second on the scene's clock; the nearest image is returned.
    pub time: f64,
    /// Longer side at most, pixels.
    pub side: usize,
}

impl PhotoQuery {
    /// Reads a query; `None`: it is not one.
    pub(crate) fn parse(query: &str) -> Option<Self> {
        let mut wanted = Self { view: 0, time: 0.0, side: MOST_SIDE };
        for (key, value) in query.split('&').filter_map(|pair| pair.split_once('=')) {
            match key {
                "view" => wanted.view = value.parse().ok()?,
                "t" => wanted.time = value.parse().ok().filter(|t: &f64| t.is_finite())?,
                "side" => wanted.side = value.parse().ok().filter(|s| (1..=MOST_SIDE).contains(s))?,
                _ => return None,
            }
        }
        Some(wanted)
    }
}

/// Finds an image; `None`: there is no such camera, or its file cannot be read.
type Find = dyn Fn(&PhotoQuery) -> Option<Photo> + Send + Sync;

/// The images of a capture.
#[derive(Clone)]
pub struct Photos(Arc<Find>);

impl Photos {
    /// `find` is called on the server's reading threads, on two at a time.
    pub fn new(find: impl Fn(&PhotoQuery) -> Option<Photo> + Send + Sync + 'static) -> Self {
        Self(Arc::new(find))
    }

    pub(crate) fn find(&self, wanted: &PhotoQuery) -> Option<Photo> {
        (self.0)(wanted)
    }
}

impl fmt::Debug for Photos {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Photos")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queries_are_read_and_nonsense_is_refused() {
        assert_eq!(PhotoQuery::parse("view=3&t=0.5&side=160"), Some(PhotoQuery { view: 3, time: 0.5, side: 160 }));
        for bad in ["view=-1", "t=nan", "side=0", "side=100000", "path=../x", "view=1&path=x"] {
            assert_eq!(PhotoQuery::parse(bad), None, "{bad}");
        }
    }
}

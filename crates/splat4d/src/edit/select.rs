//! Selections: the Gaussians of an edit, described by text that is valid for any scene.
//!
//! `box(-1,-1,0, 1,1,2) and not color(0,0.6,0, 0.2)`: predicates of positions, appearance and lifespans, never row
//! numbers, so that a selection finds the same object after the scene was trained again. See docs/edit.md for the list.

use crate::math::quat;
use crate::math::se3::{mat_vec, sub, transpose};
use crate::{Error, Result};
use std::fmt;

/// Deepest nesting of a selection: a bound for files.
const DEEPEST: usize = 64;
/// Most corners of a lasso: a bound for files.
const MOST_CORNERS: usize = 1024;
/// Most cells of a depth map: a bound for files.
const MOST_CELLS: usize = 4096;

/// A selection.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Expr {
    /// Every Gaussian.
    All,
    /// Between two corners, scene units.
    Box([f64; 3], [f64; 3]),
    /// Centre and radius, scene units.
    Sphere([f64; 3], f64),
    /// In the image of a camera, and farther than and nearer than this many scene units.
    Frustum(String, [f64; 2]),
    /// Base colour within a distance of one, 0 to 1.
    Color([f64; 3], f64),
    /// Peak opacity, least and most.
    Opacity(f64, f64),
    /// Largest standard deviation, scene units.
    Size(f64, f64),
    /// Seconds of the clip in which it can be seen.
    Life(f64, f64),
    /// Scene units per second.
    Speed(f64, f64),
    /// Name of a layer.
    Layer(String),
    /// Within what was drawn on an image.
    Lasso(Box<Lasso>),
    /// Not behind the surface that was visible in an image.
    Visible(Box<Surface>),
    /// Name of a label.
    Label(String),
    /// Features like those of the Gaussian nearest to a position, scene units: the least cosine between them.
    Like([f64; 3], f64),
    /// On the white of a mask image, seen by a camera.
    Mask(String, String),
    /// On the subject of the capture's masks.
    Subject,
    /// The inner selection at that second.
    At(f64, Box<Expr>),
    /// The inner selection at any time of a Gaussian's lifespan.
    Ever(Box<Expr>),
    /// The inner selection at all of them.
    Always(Box<Expr>),
    /// These and all within a distance of one of them, scene units.
    Grow(Box<Expr>, f64),
    /// Both.
    And(Box<Expr>, Box<Expr>),
    /// Either.
    Or(Box<Expr>, Box<Expr>),
    /// The others.
    Not(Box<Expr>),
}

/// A polygon on an image, and the depth behind it that counts.
#[derive(Clone, Debug, PartialEq)]
pub struct Lasso {
    /// Position of the image's camera, scene units.
    pub eye: [f64; 3],
    /// World from camera, wxyz of any length but zero; camera axes are OpenCV's.
    pub turn: [f64; 4],
    /// Depths z, nearest and farthest, scene units.
    pub range: [f64; 2],
    /// Corners as x/z and y/z in the camera's axes, three or more.
    pub corners: Vec<[f64; 2]>,
}

impl Lasso {
    /// Whether a point is behind the polygon, within the depths.
    pub(super) fn holds(&self, cam_from_world: &[[f64; 3]; 3], x: [f64; 3]) -> bool {
        let p = mat_vec(cam_from_world, sub(x, self.eye));
        let deep = p[2] > 0.0 && (self.range[0]..=self.range[1]).contains(&p[2]);
        deep && within(&self.corners, [p[0] / p[2], p[1] / p[2]])
    }

    /// Rows of the rotation from the world to the camera.
    pub(super) fn cam_from_world(&self) -> [[f64; 3]; 3] {
        transpose(&quat::to_rotation(quat::normalize(self.turn).0))
    }
}

/// A coarse depth map of a rectangle of an image: the largest depth that is selected in each cell.
#[derive(Clone, Debug, PartialEq)]
pub struct Surface {
    /// Camera centre, scene units.
    pub eye: [f64; 3],
    /// World from camera, wxyz of any length but zero; camera axes are OpenCV's.
    pub turn: [f64; 4],
    /// Two opposite corners as x/z and y/z in the camera's axes: the smaller values, then the larger ones.
    pub corners: [[f64; 2]; 2],
    /// Cells in a row.
    pub columns: usize,
    /// [rows · columns], scene units; 0: nothing is selected in the cell.
    pub depths: Vec<f64>,
}

impl Surface {
    /// The number of the cell of an image point (x/z, y/z).
    pub fn cell(&self, point: [f64; 2]) -> Option<usize> {
        let rows = self.depths.len() / self.columns;
        let along = |k: usize, cells: usize| {
            let [from, to] = [self.corners[0][k], self.corners[1][k]];
            let share = (point[k] - from) / (to - from);
            (0.0..=1.0).contains(&share).then(|| ((share * cells as f64) as usize).min(cells - 1))
        };
        Some(along(1, rows)? * self.columns + along(0, self.columns)?)
    }

    /// Whether a point is in the rectangle and not behind the surface.
    pub(super) fn holds(&self, cam_from_world: &[[f64; 3]; 3], x: [f64; 3]) -> bool {
        let p = mat_vec(cam_from_world, sub(x, self.eye));
        p[2] > 0.0 && self.cell([p[0] / p[2], p[1] / p[2]]).is_some_and(|cell| p[2] <= self.depths[cell])
    }

    /// Rows of the rotation from the world to the camera.
    pub(super) fn cam_from_world(&self) -> [[f64; 3]; 3] {
        transpose(&quat::to_rotation(quat::normalize(self.turn).0))
    }
}

/// Whether a point is within a polygon, by the even-odd rule.
pub fn within(polygon: &[[f64; 2]], [x, y]: [f64; 2]) -> bool {
    let mut inside = false;
    for (i, a) in polygon.iter().enumerate() {
        let b = polygon[(i + 1) % polygon.len()];
        if (a[1] > y) != (b[1] > y) && x < (b[0] - a[0]) * (y - a[1]) / (b[1] - a[1]) + a[0] {
            inside = !inside;
        }
    }
    inside
}

impl Expr {
    /// Names of the files that it reads.
    pub fn files(&self) -> Vec<String> {
        match self {
            Expr::Mask(file, _) => vec![file.clone()],
            Expr::At(_, e) | Expr::Ever(e) | Expr::Always(e) | Expr::Grow(e, _) | Expr::Not(e) => e.files(),
            Expr::And(a, b) | Expr::Or(a, b) => a.files().into_iter().chain(b.files()).collect(),
            _ => Vec::new(),
        }
    }

    /// Reads a selection. Errors: the first position that cannot be read, and what may be there.
    pub fn parse(text: &str) -> Result<Self> {
        let mut parser = Parser { text, tokens: tokens(text)?, at: 0, depth: 0 };
        let expr = parser.either()?;
        match parser.peek() {
            None => Ok(expr),
            Some(t) => Err(parser.wrong(&format!("unexpected `{t}` after the end"))),
        }
    }

    /// Whether any part of it is of this kind.
    pub(super) fn any(&self, which: &dyn Fn(&Expr) -> bool) -> bool {
        which(self)
            || match self {
                Expr::At(_, e) | Expr::Ever(e) | Expr::Always(e) | Expr::Grow(e, _) | Expr::Not(e) => e.any(which),
                Expr::And(a, b) | Expr::Or(a, b) => a.any(which) || b.any(which),
                _ => false,
            }
    }
}

#[derive(Clone, Debug, PartialEq)]
enum Token {
    Word(String),
    Text(String),
    /// Its value and its text: a camera may be called 00.
    Number(f64, String),
    Open,
    Close,
    Comma,
}

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Token::Word(w) | Token::Text(w) | Token::Number(_, w) => f.write_str(w),
            Token::Open => f.write_str("("),
            Token::Close => f.write_str(")"),
            Token::Comma => f.write_str(","),
        }
    }
}

fn unreadable(text: &str, what: &str) -> Error {
    Error::input(format!("the selection `{text}` cannot be read: {what}")).remedy(
        "A selection is made of box(x0,y0,z0, x1,y1,z1), sphere(x,y,z, r), frustum(camera), color(r,g,b, near), opacity(from,to), \
         size(from,to), life(from,to), speed(from,to), layer(name), label(name), like(x,y,z, cosine), mask(file, camera), subject, \
         lasso(...), visible(...), all, at(t, ...), \
         ever(...), always(...), grow(..., distance), and, or, not and parentheses",
    )
}

fn tokens(text: &str) -> Result<Vec<Token>> {
    let (mut out, chars): (Vec<Token>, Vec<char>) = (Vec::new(), text.chars().collect());
    let mut i = 0;
    let run = |from: usize, of: &dyn Fn(char) -> bool| from + chars[from..].iter().take_while(|c| of(**c)).count();
    while i < chars.len() {
        let c = chars[i];
        let one = match c {
            '(' => Some(Token::Open),
            ')' => Some(Token::Close),
            ',' => Some(Token::Comma),
            _ => None,
        };
        if let Some(token) = one {
            out.push(token);
            i += 1;
        } else if c.is_whitespace() {
            i += 1;
        } else if c == '"' || c == '\'' {
            let end = run(i + 1, &|x| x != c);
            if end == chars.len() {
                return Err(unreadable(text, "a quotation mark is missing"));
            }
            out.push(Token::Text(chars[i + 1..end].iter().collect()));
            i = end + 1;
        } else if c.is_ascii_digit() || "+-.".contains(c) {
            let end = run(i, &|x| x.is_ascii_alphanumeric() || "+-.".contains(x));
            let word: String = chars[i..end].iter().collect();
            let number = word.parse::<f64>().ok().filter(|x| x.is_finite());
            // Names may begin with a digit: 00.png.
            out.push(number.map_or(Token::Word(word.clone()), |x| Token::Number(x, word)));
            i = end;
        } else {
            let end = run(i, &|x| !x.is_whitespace() && !"(),\"'".contains(x));
            out.push(Token::Word(chars[i..end].iter().collect()));
            i = end;
        }
    }
    Ok(out)
}

struct Parser<'a> {
    text: &'a str,
    tokens: Vec<Token>,
    at: usize,
    depth: usize,
}

impl Parser<'_> {
    fn peek(&self) -> Option<&Token> {
        self.tokens.get(self.at)
    }

    fn wrong(&self, what: &str) -> Error {
        unreadable(self.text, what)
    }

    fn takes(&mut self, word: &str) -> bool {
        let found = matches!(self.peek(), Some(Token::Word(w)) if w == word);
        self.at += usize::from(found);
        found
    }

    fn either(&mut self) -> Result<Expr> {
        let mut left = self.both()?;
        while self.takes("or") {
            left = Expr::Or(Box::new(left), Box::new(self.both()?));
        }
        Ok(left)
    }

    fn both(&mut self) -> Result<Expr> {
        let mut left = self.one()?;
        while self.takes("and") {
            left = Expr::And(Box::new(left), Box::new(self.one()?));
        }
        Ok(left)
    }

    fn one(&mut self) -> Result<Expr> {
        self.depth += 1;
        if self.depth > DEEPEST {
            return Err(self.wrong("it is nested too deeply"));
        }
        let expr = self.factor();
        self.depth -= 1;
        expr
    }

    fn factor(&mut self) -> Result<Expr> {
        if self.takes("not") {
            return Ok(Expr::Not(Box::new(self.one()?)));
        }
        match self.peek().cloned() {
            Some(Token::Open) => {
                self.at += 1;
                let inner = self.either()?;
                self.expect(Token::Close)?;
                Ok(inner)
            }
            Some(Token::Word(word)) => {
                self.at += 1;
                self.named(&word)
            }
            Some(other) => Err(self.wrong(&format!("expected a predicate, found `{other}`"))),
            None => Err(self.wrong("expected a predicate, found the end")),
        }
    }

    fn named(&mut self, word: &str) -> Result<Expr> {
        match word {
            "all" => return Ok(Expr::All),
            "subject" => return Ok(Expr::Subject),
            _ => self.expect(Token::Open)?,
        }
        let expr = match word {
            "box" => {
                let [a, b, c, d, e, f] = self.numbers()?;
                let (low, high) = ([a.min(d), b.min(e), c.min(f)], [a.max(d), b.max(e), c.max(f)]);
                Expr::Box(low, high)
            }
            "sphere" => {
                let [x, y, z, r] = self.numbers()?;
                Expr::Sphere([x, y, z], r)
            }
            "color" => {
                let [r, g, b, near] = self.numbers()?;
                Expr::Color([r, g, b], near)
            }
            "opacity" | "size" | "life" | "speed" => {
                let [from, to] = self.numbers()?;
                match word {
                    "opacity" => Expr::Opacity(from, to),
                    "size" => Expr::Size(from, to),
                    "life" => Expr::Life(from, to),
                    _ => Expr::Speed(from, to),
                }
            }
            "layer" => Expr::Layer(self.name()?),
            "label" => Expr::Label(self.name()?),
            "like" => {
                let [x, y, z, least] = self.numbers()?;
                Expr::Like([x, y, z], least)
            }
            "frustum" => {
                let name = self.name()?;
                let mut range = [0.0, f64::INFINITY];
                if self.peek() == Some(&Token::Comma) {
                    self.at += 1;
                    range = self.numbers()?;
                }
                Expr::Frustum(name, range)
            }
            "mask" => {
                let file = self.name()?;
                self.expect(Token::Comma)?;
                Expr::Mask(file, self.name()?)
            }
            "lasso" => Expr::Lasso(Box::new(self.lasso()?)),
            "visible" => Expr::Visible(Box::new(self.surface()?)),
            "at" => {
                let [t] = self.numbers()?;
                self.expect(Token::Comma)?;
                Expr::At(t, Box::new(self.either()?))
            }
            "ever" => Expr::Ever(Box::new(self.either()?)),
            "always" => Expr::Always(Box::new(self.either()?)),
            "grow" => {
                let inner = self.either()?;
                self.expect(Token::Comma)?;
                let [distance] = self.numbers()?;
                if distance <= 0.0 {
                    return Err(self.wrong("grow needs a distance above 0"));
                }
                Expr::Grow(Box::new(inner), distance)
            }
            _ => return Err(self.wrong(&format!("there is no predicate `{word}`"))),
        };
        self.expect(Token::Close)?;
        Ok(expr)
    }

    fn expect(&mut self, token: Token) -> Result<()> {
        if self.peek() == Some(&token) {
            self.at += 1;
            return Ok(());
        }
        let found = self.peek().map_or("the end".to_owned(), |t| format!("`{t}`"));
        Err(self.wrong(&format!("`{token}` is missing before {found}")))
    }

    /// N numbers with commas between them.
    fn numbers<const N: usize>(&mut self) -> Result<[f64; N]> {
        let mut out = [0.0; N];
        for (i, out) in out.iter_mut().enumerate() {
            let few = format!("{N} numbers are needed, {i} are there");
            if i > 0 {
                self.expect(Token::Comma).map_err(|_| self.wrong(&few))?;
            }
            let Some(Token::Number(x, _)) = self.peek() else {
                return Err(self.wrong(&few));
            };
            *out = *x;
            self.at += 1;
        }
        Ok(out)
    }

    /// Eye, turn, depths and corners.
    fn lasso(&mut self) -> Result<Lasso> {
        let head: [f64; 9] = self.numbers()?;
        let mut corners = Vec::new();
        while self.peek() == Some(&Token::Comma) && corners.len() < MOST_CORNERS {
            self.at += 1;
            corners.push(self.numbers()?);
        }
        let [ex, ey, ez, w, x, y, z, near, far] = head;
        if corners.len() < 3 || [w, x, y, z].iter().map(|q| q * q).sum::<f64>() == 0.0 {
            return Err(self.wrong("a lasso has an eye, a turn, two depths, and three corners or more"));
        }
        Ok(Lasso { eye: [ex, ey, ez], turn: [w, x, y, z], range: [near, far], corners })
    }

    /// Eye, turn, two corners, columns and the depths of the cells.
    fn surface(&mut self) -> Result<Surface> {
        let head: [f64; 12] = self.numbers()?;
        let mut depths = Vec::new();
        while self.peek() == Some(&Token::Comma) && depths.len() < MOST_CELLS {
            self.at += 1;
            let [depth] = self.numbers()?;
            depths.push(depth);
        }
        let [ex, ey, ez, w, x, y, z, u0, v0, u1, v1, columns] = head;
        let turned = [w, x, y, z].iter().map(|q| q * q).sum::<f64>() > 0.0;
        let whole = columns >= 1.0 && columns <= MOST_CELLS as f64 && columns.fract() == 0.0;
        if !turned || !whole || u1 <= u0 || v1 <= v0 || depths.is_empty() || depths.len() % columns as usize != 0 {
            return Err(self.wrong(
                "visible has an eye, a turn, the smaller and the larger corner, a number of columns, and depths of whole rows",
            ));
        }
        let (columns, corners) = (columns as usize, [[u0, v0], [u1, v1]]);
        Ok(Surface { eye: [ex, ey, ez], turn: [w, x, y, z], corners, columns, depths })
    }

    /// A name, with or without quotation marks.
    fn name(&mut self) -> Result<String> {
        match self.peek().cloned() {
            Some(t @ (Token::Word(_) | Token::Text(_) | Token::Number(..))) => {
                self.at += 1;
                Ok(t.to_string())
            }
            _ => Err(self.wrong("a name is missing")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selections_are_read_with_the_usual_precedence() {
        let parsed = Expr::parse("box(1,0,0, 0,1,2) or not layer('my hair') and at(-0.5, speed(0.1, 9))").unwrap();
        let hair = Expr::Not(Box::new(Expr::Layer("my hair".into())));
        let fast = Expr::At(-0.5, Box::new(Expr::Speed(0.1, 9.0)));
        let right = Expr::And(Box::new(hair), Box::new(fast));
        assert_eq!(parsed, Expr::Or(Box::new(Expr::Box([0.0; 3], [1.0, 1.0, 2.0])), Box::new(right)));
        assert_eq!(Expr::parse("frustum(00, 1e-1, 2)").unwrap(), Expr::Frustum("00".into(), [0.1, 2.0]));
        assert_eq!(Expr::parse("mask(m/a.png, \"cam 1\")").unwrap(), Expr::Mask("m/a.png".into(), "cam 1".into()));
        assert_eq!(Expr::parse("label(left hand)").ok(), None, "names with spaces stand in quotation marks");
        assert_eq!(Expr::parse("label('left hand')").unwrap(), Expr::Label("left hand".into()));
        assert!(Expr::parse("grow(all, 0.1)").unwrap().any(&|e| *e == Expr::All));
        let Expr::Not(lasso) = Expr::parse("not lasso(1,2,3, 1,0,0,0, 0.5,9, 0,0, 1,0, 0.5,1)").unwrap() else {
            panic!()
        };
        let Expr::Lasso(lasso) = *lasso else { panic!() };
        assert_eq!((lasso.eye, lasso.range, lasso.corners.len()), ([1.0, 2.0, 3.0], [0.5, 9.0], 3));
        assert_eq!(Expr::parse("not (mask(a, b) and all)").unwrap().files(), ["a"]);
    }

    #[test]
    fn a_point_is_within_a_polygon_by_the_even_odd_rule() {
        let horseshoe =
            [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [2.0, 3.0], [2.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]];
        for (point, inside) in
            [([0.5, 2.0], true), ([1.5, 2.0], false), ([2.5, 2.0], true), ([1.5, 0.5], true), ([4.0, 0.5], false)]
        {
            assert_eq!(within(&horseshoe, point), inside, "{point:?}");
        }
    }

    #[test]
    fn unreadable_input_is_located() {
        for (text, word) in [
            ("", "found the end"),
            ("bux(1)", "bux"),
            ("box(1,2,3)", "6 numbers"),
            ("box(1,2,3,4,5,6", "missing"),
            ("all all", "unexpected"),
            ("sphere(0,0,0,nan)", "4 numbers"),
            ("layer('x", "quotation"),
            ("grow(all, 0)", "above 0"),
            ("lasso(0,0,0, 1,0,0,0, 1,9, 0,0, 1,0)", "three corners"),
            ("lasso(0,0,0, 0,0,0,0, 1,9, 0,0, 1,0, 0,1)", "a turn"),
            ("visible(0,0,0, 1,0,0,0, 0,0, 1,1, 2, 1,2,3)", "whole rows"),
            ("visible(0,0,0, 1,0,0,0, 0,0, 1,1, 0, 1)", "columns"),
            ("visible(0,0,0, 1,0,0,0, 1,0, 0,1, 1, 1)", "corner"),
            ("lasso(0,0,0, 1,0,0,0, 1,9, 0,0, 1,0, 0)", "2 numbers"),
            ("and", "and"),
        ] {
            let error = Expr::parse(text).unwrap_err().to_string();
            assert!(error.contains(word), "{text}: {error}");
        }
        assert!(Expr::parse(&"(".repeat(100_000)).unwrap_err().to_string().contains("deeply"));
    }
}

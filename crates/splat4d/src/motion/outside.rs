//! Motion models from outside the library, by name: a program that registers its model can reopen scenes that move by
//! it.

use super::{BUILT_IN, Motion};
use crate::math::Real;
use crate::scene::Params;
use crate::{Error, Result};
use std::any::Any;
use std::collections::BTreeMap;
use std::sync::{Arc, PoisonError, RwLock};

/// Makes the model, and in the parameters the tables it needs (or claims the loaded ones).
pub type MakeMotion = Arc<dyn Fn(&mut Params<f32>) -> Result<Arc<dyn Motion<f32>>> + Send + Sync>;

static REGISTERED: RwLock<BTreeMap<String, MakeMotion>> = RwLock::new(BTreeMap::new());

/// Registers the model called `name` with [`build`](super::build), and so to every reader of scenes, for the rest of
/// the process. A model of that name that was registered before is replaced. Its [`Spec`](super::Spec) is
/// `Spec::Custom(name)`.
///
/// Errors: the name is empty, has other characters than letters, digits, `-` and `_`, or is one of the library's.
pub fn register(name: &str, make: MakeMotion) -> Result<()> {
    if BUILT_IN.contains(&name) || name == "auto" {
        return Err(Error::input(format!("`{name}` is the name of one of splat4d's own motion models"))
            .remedy("Give your model another name"));
    }
    if name.is_empty() || !name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_') {
        return Err(
            Error::input(format!("a motion model cannot be called `{name}`")).remedy("Use letters, digits, - and _")
        );
    }
    REGISTERED.write().unwrap_or_else(PoisonError::into_inner).insert(name.to_owned(), make);
    Ok(())
}

/// Whether a model of that name is registered.
pub fn is_registered(name: &str) -> bool {
    REGISTERED.read().unwrap_or_else(PoisonError::into_inner).contains_key(name)
}

/// The registered model of that name, made; `None`: there is none, or F is not `f32`, the numbers that scenes are made
/// of.
pub(super) fn build<F: Real>(name: &str, p: &mut Params<F>) -> Option<Result<Arc<dyn Motion<F>>>> {
    // Cloned, so that a model may register another while it is made.
    let make = REGISTERED.read().unwrap_or_else(PoisonError::into_inner).get(name).cloned()?;
    let p = (p as &mut dyn Any).downcast_mut::<Params<f32>>()?;
    Some(make(p).map(|motion| {
        let made: Box<dyn Any> = Box::new(motion);
        *made.downcast::<Arc<dyn Motion<F>>>().expect("the parameters were of f32, so F is")
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::scene;
    use crate::layers::{Evaluation, Layer, Scene};
    use crate::motion::still::Still;
    use crate::motion::{At, Cache, Spec, Tape};
    use crate::scene::{GEOMETRY, Grads, Key, LifeKind, Space, SplatGrads, Time};

    /// Falls with a speed of its own a Gaussian, scene units per second.
    struct Falls(Key);

    impl Falls {
        fn make(p: &mut Params<f32>) -> Result<Arc<dyn Motion<f32>>> {
            let rows = p.len();
            Ok(Arc::new(Self(p.entry("speeds", Space::Gaussians, &[("speeds", 1)], rows, |_| {})?)))
        }
    }

    impl Motion for Falls {
        fn spec(&self) -> Spec {
            Spec::Custom("falls".into())
        }

        fn scratch_bytes(&self, _: &Params, _: usize) -> u64 {
            0
        }

        fn at(&self, q: &At<'_>, cache: &Cache, tape: &mut Tape) {
            Motion::<f32>::at(&Still, q, cache, tape);
            for j in 0..q.len() {
                let fallen = q.p[self.0].get(q.rows.id(j), 0) * q.t.0 as f32;
                tape.out.add(j, 1, [-fallen]);
            }
        }

        fn backward(
            &self,
            _: &At<'_>,
            _: &Cache,
            _: &mut Tape,
            _: &SplatGrads<'_>,
            _: &mut Cache,
            _: &mut Grads,
        ) -> f64 {
            unreachable!("the test does not learn")
        }
    }

    #[test]
    fn a_scene_that_moves_by_a_registered_model_is_read_again() {
        let mut params = Params::<f32>::new(2, 1, LifeKind::Infinite.columns());
        params[GEOMETRY].write(0, 3, [1.0, 0.0, 0.0, 0.0]);
        params[GEOMETRY].write(1, 3, [1.0, 0.0, 0.0, 0.0]);
        let motion = Falls::make(&mut params).unwrap();
        let key = params.find("speeds").unwrap();
        params[key].set(1, 0, 2.0);
        let layer = Layer::new("falling", params, motion, LifeKind::Infinite);
        let written =
            Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, up: [0.0, 1.0, 0.0], ..Scene::default() };
        let mut bytes = Vec::new();
        scene::write(&written, &mut bytes).unwrap();
        let unknown = scene::read(&bytes).expect_err("nobody has registered it").to_string();
        assert!(unknown.contains("falls") && unknown.contains("register"), "{unknown}");

        register("falls", Arc::new(Falls::make)).unwrap();
        let read = scene::read(&bytes).unwrap();
        let height = |scene: &Scene| {
            let mut seen = Evaluation::default();
            scene.at(Time(0.5), &mut seen);
            seen.tapes().next().unwrap().out().get(1, 1)
        };
        assert_eq!(height(&read), height(&written));
        assert_eq!(height(&read), -1.0);
    }

    #[test]
    fn duplicate_and_unwritable_names_are_refused() {
        for name in ["still", "auto", "filtered", "", "a b", "../x"] {
            assert!(register(name, Arc::new(Falls::make)).is_err(), "{name}");
        }
    }
}

//! The files of a prediction, except its page.

use super::{Forecast, Summary, Work};
use crate::baking::{Baking, bake_into};
use crate::events::Listener;
use crate::source::Source;
use crate::{files, playable};
use splat4d::Result;
use splat4d::format::safetensors::{self, Tensor};
use splat4d_dynamics::paths::Moment;
use std::collections::BTreeMap;
use std::path::Path;

/// `predict.json`, `dynamics.safetensors`, `scene.safetensors` and `scene.s4d`.
pub(super) fn all(
    work: &Work,
    folder: &Path,
    summary: &Summary,
    forecasts: &[Forecast],
    best: &Forecast,
    console: &dyn Listener,
) -> Result<()> {
    files::write(&folder.join("predict.json"), &serde_json::to_vec_pretty(summary).expect("results are plain data"))?;
    files::write(&folder.join("dynamics.safetensors"), &dynamics(work, forecasts)?)?;
    let mut bytes = Vec::new();
    splat4d::format::scene::write(&best.scene, &mut bytes)?;
    files::write(&folder.join("scene.safetensors"), &bytes)?;
    let source =
        Source { run: Some(crate::run_folder::Run::open(&work.order.run)?), ..Source::own(best.scene.clone()) };
    let title = format!("{}, predicted by {}", work.run.name(), best.model.name());
    bake_into(&source, &title, &folder.join(playable::FILE), &Baking::default(), console)?;
    Ok(())
}

/// Paths of the nodes as observed and as each model continues, and the weights of what was trained:
/// `observed.positions` \[ticks, nodes, 3], `observed.rotations` \[ticks, nodes, 4] wxyz, `MODEL.positions`,
/// `MODEL.rotations`, `MODEL.SEED.WEIGHT`.
fn dynamics(work: &Work, forecasts: &[Forecast]) -> Result<Vec<u8>> {
    let mut arrays: Vec<(String, Vec<usize>, Vec<f32>)> = Vec::new();
    let mut moments = |name: &str, moments: &[Moment]| {
        let nodes = work.observed.paths.nodes();
        let x = moments.iter().flatten().flat_map(|p| p.x.map(|v| v as f32)).collect();
        let q = moments.iter().flatten().flat_map(|p| p.q.map(|v| v as f32)).collect();
        arrays.push((format!("{name}.positions"), vec![moments.len(), nodes, 3], x));
        arrays.push((format!("{name}.rotations"), vec![moments.len(), nodes, 4], q));
    };
    moments("observed", &work.observed.paths.moments);
    forecasts.iter().for_each(|f| moments(f.model.name(), &f.moments));
    for f in forecasts {
        for (seed, params) in f.fitted.iter().enumerate().filter_map(|(i, m)| Some((i, m.params()?))) {
            for key in params.keys().filter(|&k| params[k].rows() > 0) {
                let name = format!("{}.{seed}.{}", f.model.name(), params.info(key).name);
                let rows = params[key].rows();
                arrays.push((name, vec![rows], params[key].data()[..rows].to_vec()));
            }
        }
    }
    let tensors: Vec<Tensor<'_>> =
        arrays.iter().map(|(name, shape, data)| Tensor::f32(name.clone(), shape, data)).collect();
    let about = serde_json::json!({
        "version": 1, "until": work.clock.until, "fps": work.clock.fps, "nodes": work.observed.paths.nodes(),
        "models": forecasts.iter().map(|f| f.model.name()).collect::<Vec<_>>(),
    });
    let metadata = BTreeMap::from([("splat4d-dynamics".to_owned(), about.to_string())]);
    let mut bytes = Vec::new();
    safetensors::write(&tensors, &metadata, &mut bytes)?;
    Ok(bytes)
}

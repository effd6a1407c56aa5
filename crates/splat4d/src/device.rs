//! The device that draws: the GPU where there is one that can, else the CPU, and a sentence that says why.

#[cfg(test)]
mod tests;

use crate::render::{Backend, Image, RenderConfig, Renderer, Shot, Tables, Wanted};
use crate::{Error, Result};

/// The choice of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Device {
    /// The GPU if there is one, else the CPU; never a driver that computes on the CPU.
    Auto,
    /// The CPU.
    Cpu,
    /// Any Vulkan, Metal or Direct3D 12 driver, even one that computes on the CPU.
    Gpu,
}

/// An open device.
pub struct Opened {
    /// It.
    pub backend: Box<dyn Backend>,
    /// The device in words; where it is not the one that was asked for, the reason too.
    pub why: String,
    /// Whether there is no GPU to draw on although one was asked for.
    pub fell_back: bool,
}

/// The renderer of the CPU, which can do everything. It is compiled here, once for all crates that draw through a
/// [`Backend`].
pub fn cpu(config: RenderConfig) -> Box<dyn Backend> {
    Box::new(Renderer::new(config))
}

/// The device that was asked for, if it has the abilities in `wanted`, or else the CPU.
pub fn open(device: Device, config: RenderConfig, wanted: &Wanted, tables: Tables) -> Opened {
    if device == Device::Cpu {
        return Opened { backend: cpu(config), why: "drawing on the CPU".into(), fell_back: false };
    }
    match gpu(device, config, wanted, tables) {
        Ok((backend, name)) => Opened { backend, why: format!("drawing on {name}"), fell_back: false },
        Err(reason) => on_cpu(config, &reason),
    }
}

/// The CPU instead of the GPU that was asked for.
pub fn on_cpu(config: RenderConfig, reason: &dyn std::fmt::Display) -> Opened {
    Opened { backend: cpu(config), why: format!("drawing on the CPU: {reason}"), fell_back: true }
}

/// Draws. A backend that fails on the way is left for the CPU, which draws instead; its error is returned.
pub fn draw(backend: &mut Box<dyn Backend>, shot: &Shot<'_>, out: &mut Image) -> Option<Error> {
    let error = backend.render(shot, out).err()?;
    *backend = cpu(*backend.config());
    backend.render(shot, out).expect("the CPU draws everything");
    Some(error)
}

#[cfg(not(feature = "gpu"))]
fn gpu(_: Device, _: RenderConfig, _: &Wanted, _: Tables) -> Result<(Box<dyn Backend>, String)> {
    Err(Error::new(crate::ErrorKind::Unsupported, "this splat4d was built without the feature `gpu`"))
}

#[cfg(feature = "gpu")]
fn gpu(device: Device, config: RenderConfig, wanted: &Wanted, tables: Tables) -> Result<(Box<dyn Backend>, String)> {
    use crate::gpu::{Adapters, Gpu, GpuRenderer};
    // Cheap, where opening a driver takes a moment.
    GpuRenderer::refuses(wanted)?;
    let gpu = Gpu::open(if device == Device::Gpu { Adapters::Any } else { Adapters::Hardware })?;
    let name = gpu.describe();
    let mut renderer = GpuRenderer::new(gpu, config)?;
    renderer.tables = tables;
    Ok((Box::new(renderer), name))
}

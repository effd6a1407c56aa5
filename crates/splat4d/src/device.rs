//! Selects the rendering device: a suitable GPU if there is one, otherwise the CPU; and reports why.

mod probe;
mod resident;
#[cfg(test)]
mod tests;

pub use resident::ResidentMotion;

#[cfg(not(feature = "gpu"))]
use crate::ErrorKind;
#[cfg(feature = "gpu")]
use crate::gpu::{Adapters, Gpu, GpuRenderer, Tuning};
use crate::render::{
    Abilities, Backend, Comparison, Image, ImageGrads, RenderConfig, RenderGrads, Renderer, Resident, Shot, Tables,
    Target,
};
use crate::scene::Table;
use crate::{Error, Result};
#[cfg(feature = "gpu")]
use probe::Work;

/// The name of the CPU as a device.
const CPU: &str = "the CPU";

/// The choice of a device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Device {
    /// The GPU if there is one that passes a self-test and is no slower than the CPU, else the CPU; never a driver that
    /// computes on the CPU.
    Auto,
    /// The CPU.
    #[default]
    Cpu,
    /// Any Vulkan, Metal or Direct3D 12 driver, even one that computes on the CPU.
    Gpu,
}

/// An open device.
pub struct Opened {
    /// It.
    pub backend: Box<dyn Backend>,
    /// It in words: of a GPU its driver too.
    pub name: String,
    /// The device in words; where it is not the requested one, the reason too.
    pub why: String,
    /// Whether there is no GPU to render on although one was requested.
    pub fell_back: bool,
}

/// The renderer of the CPU, which can do everything. It is compiled here, once for all crates that render through a
/// [`Backend`].
pub fn cpu(config: RenderConfig) -> Box<dyn Backend> {
    Box::new(Renderer::new(config))
}

/// The requested device, if it has these abilities, or else the CPU.
pub fn open(device: Device, config: RenderConfig, abilities: &Abilities, tables: Tables) -> Opened {
    if device == Device::Cpu {
        let why = format!("rendering on {CPU}");
        return Opened { backend: cpu(config), name: CPU.into(), why, fell_back: false };
    }
    or_cpu(config, gpu(device, config, abilities, tables))
}

/// A GPU and its name, or, where there is none, the CPU and why.
fn or_cpu(config: RenderConfig, gpu: Result<(Box<dyn Backend>, String)>) -> Opened {
    match gpu {
        Ok((backend, name)) => Opened { backend, why: format!("rendering on {name}"), name, fell_back: false },
        Err(reason) => on_cpu(config, &reason),
    }
}

/// The requested device, together with the CPU, which renders what the GPU does not support, image by image, and a GPU
/// that fails is not used again. Each is reported once ([`Backend::notice`]), and neither is an error.
pub fn open_to_train(device: Device, config: RenderConfig) -> Opened {
    let opened = open(device, config, &Abilities { backward: true, ..Abilities::default() }, Tables::Changing);
    let why = opened.why.replacen("rendering", "training", 1);
    match device == Device::Cpu || opened.fell_back {
        true => Opened { why, ..opened },
        false => Opened { backend: Box::new(WithCpu::new(opened.backend)), why, name: opened.name, fell_back: false },
    }
}

/// The CPU instead of the requested GPU.
pub fn on_cpu(config: RenderConfig, reason: &dyn std::fmt::Display) -> Opened {
    Opened { backend: cpu(config), name: CPU.into(), why: format!("rendering on {CPU}: {reason}"), fell_back: true }
}

/// Renders. If the backend fails, the CPU takes over and the error is returned.
pub fn draw(backend: &mut Box<dyn Backend>, shot: &Shot<'_>, out: &mut Image) -> Option<Error> {
    let error = backend.render(shot, out).err()?;
    *backend = cpu(*backend.config());
    backend.render(shot, out).expect("the CPU renders everything");
    Some(error)
}

/// A device, and the CPU for what it cannot do.
struct WithCpu {
    /// Until it fails.
    other: Option<Box<dyn Backend>>,
    cpu: Box<dyn Backend>,
    /// Whether the last image is the other's.
    drawn_by_other: bool,
    /// Why it was refused.
    refused: Vec<String>,
    notices: Vec<String>,
    /// Target of images that are rendered again.
    again: Image,
    name: String,
}

impl WithCpu {
    fn new(other: Box<dyn Backend>) -> Self {
        let (config, name) = (*other.config(), other.name().to_owned());
        Self {
            other: Some(other),
            cpu: cpu(config),
            drawn_by_other: false,
            refused: Vec::new(),
            notices: Vec::new(),
            again: Image::default(),
            name,
        }
    }

    /// The other device, if it is there and can render a shot and take it back.
    fn able(&mut self, shot: &Shot<'_>) -> Option<&mut Box<dyn Backend>> {
        let other = self.other.as_mut()?;
        match other.can(&Abilities { backward: true, ..shot.abilities() }) {
            Ok(()) => Some(other),
            Err(refusal) => {
                let why = refusal.cause();
                if !self.refused.contains(&why) {
                    self.notices.push(format!("the CPU renders what the GPU does not: {why}"));
                    self.refused.push(why);
                }
                None
            }
        }
    }

    fn leave(&mut self, error: &Error) {
        self.other = None;
        self.name = CPU.into();
        self.notices.push(format!("training continues on the CPU: {}", error.cause()));
    }
}

impl Backend for WithCpu {
    fn can(&self, abilities: &Abilities) -> Result<()> {
        match &self.other {
            Some(other) if abilities.compare => other.can(abilities),
            _ => self.cpu.can(abilities),
        }
    }

    fn render(&mut self, shot: &Shot<'_>, out: &mut Image) -> Result<()> {
        self.drawn_by_other = false;
        match self.able(shot).map(|other| other.render(shot, out)) {
            Some(Ok(())) => {
                self.drawn_by_other = true;
                return Ok(());
            }
            Some(Err(error)) => self.leave(&error),
            None => {}
        }
        self.cpu.render(shot, out)
    }

    fn vjp(
        &mut self,
        shot: &Shot<'_>,
        grads: &ImageGrads<'_>,
        d_sh: &mut [Option<&mut Table>],
        d: &mut RenderGrads,
    ) -> Result<()> {
        if let Some(other) = self.other.as_mut().filter(|_| self.drawn_by_other) {
            match other.vjp(shot, grads, d_sh, d) {
                Ok(()) => return Ok(()),
                Err(error) => self.leave(&error),
            }
            self.drawn_by_other = false;
            self.cpu.render(shot, &mut self.again)?;
        }
        self.cpu.vjp(shot, grads, d_sh, d)
    }

    fn compare(
        &mut self,
        shot: &Shot<'_>,
        target: &Target<'_>,
        d_sh: &mut [Option<&mut Table>],
        d: &mut RenderGrads,
    ) -> Result<Option<Comparison>> {
        self.drawn_by_other = false;
        match self.able(shot).map(|other| other.compare(shot, target, d_sh, d)) {
            Some(Ok(compared)) => {
                self.drawn_by_other = compared.is_some();
                return Ok(compared);
            }
            Some(Err(error)) => self.leave(&error),
            None => {}
        }
        Ok(None)
    }

    fn resident(&mut self) -> Option<&mut dyn Resident> {
        self.other.as_mut()?.resident()
    }

    fn radii(&self) -> &[f32] {
        match &self.other {
            Some(other) if self.drawn_by_other => other.radii(),
            _ => self.cpu.radii(),
        }
    }

    fn config(&self) -> &RenderConfig {
        self.cpu.config()
    }

    fn name(&self) -> &str {
        &self.name
    }

    fn notice(&mut self) -> Option<String> {
        if self.notices.is_empty() { None } else { Some(self.notices.remove(0)) }
    }
}

#[cfg(not(feature = "gpu"))]
fn gpu(_: Device, _: RenderConfig, _: &Abilities, _: Tables) -> Result<(Box<dyn Backend>, String)> {
    Err(Error::new(ErrorKind::Unsupported, "this splat4d was built without the feature `gpu`"))
}

#[cfg(feature = "gpu")]
fn gpu(
    device: Device,
    config: RenderConfig,
    abilities: &Abilities,
    tables: Tables,
) -> Result<(Box<dyn Backend>, String)> {
    // Cheap, where opening a driver takes a moment. The CPU is chosen without the advice to choose it.
    GpuRenderer::refuses(abilities).map_err(|refusal| Error::new(refusal.kind(), refusal.cause()))?;
    let adapters = if device == Device::Gpu { Adapters::Any } else { Adapters::Hardware };
    let work = if abilities.backward { Work::Step } else { Work::Image };
    let (mut renderer, name) = tested(&|| Gpu::open(adapters), config, work, &mut |gpu| work.trusted(gpu))?;
    if device == Device::Auto {
        work.slower_once(&mut renderer).map_err(|e| e.at(&name))?;
    }
    renderer.forget_scene();
    renderer.tables = tables;
    Ok((Box::new(renderer), name))
}

/// A test of a renderer.
#[cfg(feature = "gpu")]
type SelfTest<'a> = &'a mut dyn FnMut(&mut dyn Backend) -> Result<()>;

/// A renderer that has passed a test, and its name: with subgroups, or else without. Errors: it has passed neither;
/// that of the first is reported.
#[cfg(feature = "gpu")]
fn tested(
    open: &dyn Fn() -> Result<Gpu>,
    config: RenderConfig,
    work: Work,
    test: SelfTest<'_>,
) -> Result<(GpuRenderer, String)> {
    let mut tested = |gpu: Gpu| -> Result<(GpuRenderer, String)> {
        let name = gpu.describe();
        let mut renderer = GpuRenderer::new(gpu, config)?;
        if work == Work::Step {
            renderer.for_training()?;
        }
        test(&mut renderer).map_err(|e| e.at(&name))?;
        Ok((renderer, name))
    };
    tested(open()?).or_else(|error| {
        // Subgroups are the newest part of drivers.
        let portable = open()?.tuned(Tuning { subgroups: false, ..Tuning::default() });
        tested(portable).map_err(|_| error)
    })
}

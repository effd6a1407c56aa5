//! Which device draws: the GPU where there is one, else the CPU, and one line that says why.

use crate::console::Console;
use splat4d::render::{Image, RenderConfig, Renderer};
use splat4d::scene::{Camera, Splats};

#[cfg(feature = "gpu")]
use splat4d::gpu::{Adapters, Gpu, GpuRenderer, Tables};

/// What draws.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Device {
    /// The GPU if there is one, else the CPU
    Auto,
    /// The CPU
    Cpu,
    /// Any Vulkan, Metal or Direct3D 12 driver, even one that computes on the CPU
    Gpu,
}

/// Files of which one is there where Linux has a driver for a GPU: asking Vulkan itself costs time, and its loader
/// complains on stderr on machines without a screen.
#[cfg(all(feature = "gpu", target_os = "linux"))]
const LINUX_GPUS: [&str; 5] = ["/dev/dri", "/dev/nvidiactl", "/dev/kfd", "/dev/dxg", "/dev/mali0"];

/// A renderer, and whom to tell when it fails.
pub(crate) struct Brush<'a> {
    renderer: Kind,
    #[cfg_attr(not(feature = "gpu"), allow(dead_code, reason = "only a GPU can fail"))]
    console: Option<&'a Console>,
}

enum Kind {
    Cpu(Box<Renderer<f32>>),
    #[cfg(feature = "gpu")]
    Gpu(Box<GpuRenderer>),
}

impl Kind {
    fn cpu(config: RenderConfig) -> Self {
        Self::Cpu(Box::new(Renderer::new(config)))
    }

    #[cfg(not(feature = "gpu"))]
    fn gpu(_: Device, _: RenderConfig, _: &Console) -> Result<Self, String> {
        Err("this splat4d was built without the feature `gpu`".into())
    }

    #[cfg(feature = "gpu")]
    fn gpu(device: Device, config: RenderConfig, console: &Console) -> Result<Self, String> {
        #[cfg(target_os = "linux")]
        if device == Device::Auto && !LINUX_GPUS.iter().any(|p| std::path::Path::new(p).exists()) {
            return Err("this machine has no GPU".into());
        }
        let adapters = if device == Device::Gpu { Adapters::Any } else { Adapters::Hardware };
        let gpu = Gpu::open(adapters).map_err(|e| e.to_string())?;
        console.detail(&format!("drawing on {}", gpu.describe()));
        let mut renderer = GpuRenderer::new(gpu, config).map_err(|e| e.to_string())?;
        // A painter borrows its scene: the scene's own colours cannot change while it draws.
        renderer.tables = Tables::Constant;
        Ok(Self::Gpu(Box::new(renderer)))
    }
}

impl<'a> Brush<'a> {
    /// The CPU.
    pub(crate) fn cpu(config: RenderConfig) -> Self {
        Self { renderer: Kind::cpu(config), console: None }
    }

    /// The device that was asked for, or the CPU and a line that says why.
    pub(crate) fn open(device: Device, config: RenderConfig, console: &'a Console) -> Self {
        if device == Device::Cpu {
            return Self::cpu(config);
        }
        let renderer = Kind::gpu(device, config, console).unwrap_or_else(|reason| {
            let line = format!("drawing on the CPU: {reason}");
            if device == Device::Gpu {
                console.warn(&line)
            } else {
                console.detail(&line)
            }
            Kind::cpu(config)
        });
        Self { renderer, console: Some(console) }
    }

    /// Draws. A GPU that fails on the way is said, and left for the CPU.
    pub(crate) fn draw(
        &mut self,
        splats: &Splats<'_, f32>,
        camera: &Camera,
        background: [f32; 3],
        image: &mut Image<f32>,
    ) {
        #[cfg(feature = "gpu")]
        if let Kind::Gpu(renderer) = &mut self.renderer {
            match renderer.render(splats, camera, background, image) {
                Ok(()) => return,
                Err(e) => {
                    if let Some(console) = self.console {
                        console.warn(&format!("drawing on the CPU: {e}"));
                    }
                }
            }
            let config = renderer.config;
            self.renderer = Kind::cpu(config);
        }
        match &mut self.renderer {
            Kind::Cpu(renderer) => renderer.render(splats, camera, background, None, image),
            #[cfg(feature = "gpu")]
            Kind::Gpu(_) => unreachable!("it has drawn, or was left"),
        }
    }

    /// What draws, in words.
    pub(crate) fn name(&self) -> String {
        match &self.renderer {
            Kind::Cpu(_) => "the CPU".into(),
            #[cfg(feature = "gpu")]
            Kind::Gpu(renderer) => renderer.gpu().name().to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::console::Loudness;

    #[test]
    fn the_cpu_is_always_there() {
        let console = Console::new(Loudness::Quiet, false);
        for device in [Device::Cpu, Device::Auto] {
            let mut brush = Brush::open(device, RenderConfig::default(), &console);
            let pose = splat4d::math::Se3::look_at([0.0, 0.0, -1.0], [0.0; 3], [0.0, -1.0, 0.0]);
            let camera = Camera::with_fov_y(pose, 1.0, 3, 2);
            let mut image = Image::default();
            brush.draw(&Splats::default(), &camera, [0.25, 0.5, 0.75], &mut image);
            assert_eq!(image.color.data[..7], [0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.5]);
            assert!(device != Device::Cpu || brush.name() == "the CPU");
        }
        assert!(console.warnings().is_empty(), "only a GPU that was demanded is missed aloud");
    }
}

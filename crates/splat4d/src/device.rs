//! The device that draws: the GPU where there is one that can, else the CPU, and a sentence that says why.

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Se3;
    use crate::render::{ImageGrads, RenderGrads};
    use crate::scene::{Camera, Splats, Table};
    use crate::{ErrorKind, Result};

    fn view() -> Camera {
        Camera::with_fov_y(Se3::look_at([0.0, 0.0, -1.0], [0.0; 3], [0.0, -1.0, 0.0]), 1.0, 3, 2)
    }

    const BACKGROUND: [f32; 3] = [0.25, 0.5, 0.75];

    #[test]
    fn the_cpu_is_always_there() {
        for device in [Device::Cpu, Device::Auto, Device::Gpu] {
            let mut opened = open(device, RenderConfig::default(), &Wanted::default(), Tables::Constant);
            let (splats, camera, mut image) = (Splats::default(), view(), Image::default());
            assert!(draw(&mut opened.backend, &Shot::new(&splats, &camera, BACKGROUND), &mut image).is_none());
            assert_eq!(image.color.data[..7], [0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.5]);
            assert!(opened.why.starts_with("drawing on "), "{}", opened.why);
            assert_eq!(opened.fell_back, device != Device::Cpu && opened.backend.name() == "the CPU");
        }
    }

    #[test]
    fn what_only_the_cpu_can_is_done_by_the_cpu() {
        for wanted in [
            Wanted { head: true, ..Wanted::default() },
            Wanted { extra: true, ..Wanted::default() },
            Wanted { backward: true, ..Wanted::default() },
        ] {
            let opened = open(Device::Gpu, RenderConfig::default(), &wanted, Tables::Changing);
            assert!(opened.fell_back && opened.backend.can(&wanted).is_ok(), "{}", opened.why);
        }
    }

    /// A device whose driver fails at its second picture.
    struct Failing {
        renderer: Renderer<f32>,
        drawn: usize,
    }

    impl Backend for Failing {
        fn can(&self, _: &Wanted) -> Result<()> {
            Ok(())
        }
        fn render(&mut self, shot: &Shot<'_>, out: &mut Image) -> Result<()> {
            self.drawn += 1;
            if self.drawn > 1 {
                return Err(Error::new(ErrorKind::Unsupported, "the driver is gone"));
            }
            Backend::render(&mut self.renderer, shot, out)
        }
        fn vjp(
            &mut self,
            _: &Shot<'_>,
            _: &ImageGrads<'_>,
            _: &mut [Option<&mut Table>],
            _: &mut RenderGrads,
        ) -> Result<()> {
            Ok(())
        }
        fn radii(&self) -> &[f32] {
            &[]
        }
        fn config(&self) -> &RenderConfig {
            &self.renderer.config
        }
        fn name(&self) -> &str {
            "failing"
        }
    }

    #[test]
    fn a_device_that_fails_on_the_way_is_left_for_the_cpu() {
        let config = RenderConfig { low_pass: 0.5, ..RenderConfig::default() };
        let mut backend: Box<dyn Backend> = Box::new(Failing { renderer: Renderer::new(config), drawn: 0 });
        let (splats, camera, mut image) = (Splats::default(), view(), Image::default());
        let shot = Shot::new(&splats, &camera, BACKGROUND);
        assert!(draw(&mut backend, &shot, &mut image).is_none() && backend.name() == "failing");
        image.color.data.fill(9.0);
        let error = draw(&mut backend, &shot, &mut image).expect("the driver is gone");
        assert!(error.to_string().contains("gone") && backend.name() == "the CPU");
        assert!(image.color.plane(0).iter().all(|v| *v == BACKGROUND[0]), "the CPU has drawn instead");
        assert_eq!(backend.config().low_pass, 0.5, "with the same limits");
        assert!(draw(&mut backend, &shot, &mut image).is_none(), "and goes on");
    }
}

//! `--device`: the choice of the device that draws, and the line that says what came of it.

use crate::console::Console;
use splat4d::device::{self, Opened};
use splat4d::render::{RenderConfig, Tables, Wanted};

/// Device that renders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Device {
    /// A GPU if there is one, otherwise the CPU
    Auto,
    /// The CPU
    Cpu,
    /// Any Vulkan, Metal or Direct3D 12 driver, including software drivers
    Gpu,
}

/// Files of which one is there where Linux has a driver for a GPU: asking Vulkan itself costs time, and its loader
/// complains on stderr on machines without a screen.
const LINUX_GPUS: [&str; 5] = ["/dev/dri", "/dev/nvidiactl", "/dev/kfd", "/dev/dxg", "/dev/mali0"];

/// What is said where `auto` finds none.
const NO_GPU: &str = "this machine has no GPU";

/// Whether there is none for certain.
fn no_gpu() -> bool {
    cfg!(all(feature = "gpu", target_os = "linux")) && !LINUX_GPUS.iter().any(|p| std::path::Path::new(p).exists())
}

/// The device to train on.
pub(crate) fn to_train(device: Device, console: &Console) -> device::Device {
    chosen(device, "training", console)
}

/// The device that does something; where there is certainly no GPU for `auto`, that is said here.
pub(crate) fn chosen(device: Device, does: &str, console: &Console) -> device::Device {
    match device {
        Device::Auto if no_gpu() => {
            console.say(&format!("{does} on the CPU: {NO_GPU}"));
            device::Device::Cpu
        }
        Device::Auto => device::Device::Auto,
        Device::Cpu => device::Device::Cpu,
        Device::Gpu => device::Device::Gpu,
    }
}

/// Opens the device for a scene that does not change; only a GPU that was demanded is missed aloud.
pub(crate) fn open(device: Device, config: RenderConfig, wanted: &Wanted, console: &Console) -> Opened {
    let opened = match device {
        Device::Auto if no_gpu() => device::on_cpu(config, &NO_GPU),
        Device::Auto => device::open(device::Device::Auto, config, wanted, Tables::Constant),
        Device::Cpu => device::open(device::Device::Cpu, config, wanted, Tables::Constant),
        Device::Gpu => device::open(device::Device::Gpu, config, wanted, Tables::Constant),
    };
    match device {
        Device::Gpu if opened.fell_back => console.warn(&opened.why),
        Device::Cpu => {}
        _ => console.detail(&opened.why),
    }
    opened
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::console::Loudness;

    #[test]
    fn only_a_gpu_that_was_demanded_is_missed_aloud() {
        let headed = Wanted { head: true, ..Wanted::default() };
        for (device, wanted, warnings) in [
            (Device::Cpu, headed, 0),
            (Device::Auto, Wanted::default(), 0),
            (Device::Auto, headed, 0),
            (Device::Gpu, headed, 1),
        ] {
            let console = Console::new(Loudness::Quiet, false);
            let opened = open(device, RenderConfig::default(), &wanted, &console);
            assert!(opened.backend.can(&wanted).is_ok(), "{}", opened.why);
            assert_eq!(console.warnings().len(), warnings, "{device:?}: {}", opened.why);
        }
    }
}

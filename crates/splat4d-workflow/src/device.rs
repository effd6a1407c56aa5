//! The choice of the device that renders, and the line that reports it.

use crate::events::Listener;
use splat4d::device::{self, Device, Opened};
use splat4d::render::{Abilities, RenderConfig, Tables};

/// Files of which one is there where Linux has a driver for a GPU: querying Vulkan costs time, and its loader complains
/// on stderr on machines without a screen.
const LINUX_GPUS: [&str; 5] = ["/dev/dri", "/dev/nvidiactl", "/dev/kfd", "/dev/dxg", "/dev/mali0"];

/// Message if `auto` finds none.
const NO_GPU: &str = "this machine has no GPU";

/// Whether there is none for certain.
fn no_gpu() -> bool {
    cfg!(all(feature = "gpu", target_os = "linux")) && !LINUX_GPUS.iter().any(|p| std::path::Path::new(p).exists())
}

/// The device, or the CPU where there is certainly no GPU for `auto`.
pub(crate) fn present(device: Device) -> Device {
    if device == Device::Auto && no_gpu() { Device::Cpu } else { device }
}

/// The device that does something; where there is certainly no GPU for `auto`, that is reported here.
pub fn chosen(device: Device, does: &str, listener: &dyn Listener) -> Device {
    if device == Device::Auto && no_gpu() {
        listener.result(&format!("{does} on the CPU: {NO_GPU}"));
        return Device::Cpu;
    }
    device
}

/// Opens the device for a scene that does not change; only a GPU that was demanded is missed aloud.
pub fn open(device: Device, config: RenderConfig, abilities: &Abilities, listener: &dyn Listener) -> Opened {
    let opened = match device {
        Device::Auto if no_gpu() => device::on_cpu(config, &NO_GPU),
        device => device::open(device, config, abilities, Tables::Constant),
    };
    match device {
        Device::Gpu if opened.fell_back => listener.warn(&opened.why),
        Device::Cpu => {}
        _ => listener.detail(&opened.why),
    }
    opened
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::events::Event;
    use std::cell::Cell;

    #[test]
    fn only_an_explicit_gpu_request_warns_if_unsupported() {
        let headed = Abilities { head: true, ..Abilities::default() };
        for (device, abilities, warnings) in [
            (Device::Cpu, headed, 0),
            (Device::Auto, Abilities::default(), 0),
            (Device::Auto, headed, 0),
            (Device::Gpu, headed, 1),
        ] {
            let warned = Cell::new(0);
            let count = |event: &Event<'_>| warned.set(warned.get() + usize::from(matches!(event, Event::Warning(_))));
            let opened = open(device, RenderConfig::default(), &abilities, &count);
            assert!(opened.backend.can(&abilities).is_ok(), "{}", opened.why);
            assert_eq!(warned.get(), warnings, "{device:?}: {}", opened.why);
        }
    }
}

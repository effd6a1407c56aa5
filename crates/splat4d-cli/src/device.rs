//! `--device`: the names of devices.

/// Device that renders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Device {
    /// A GPU if there is one that is no slower than the CPU, otherwise the CPU
    Auto,
    /// The CPU
    Cpu,
    /// Any Vulkan, Metal or Direct3D 12 driver, including software drivers
    Gpu,
}

impl From<Device> for splat4d::device::Device {
    fn from(device: Device) -> Self {
        match device {
            Device::Auto => Self::Auto,
            Device::Cpu => Self::Cpu,
            Device::Gpu => Self::Gpu,
        }
    }
}

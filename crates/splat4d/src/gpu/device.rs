//! Choice and opening of the GPU: nothing beyond WebGPU's default limits is requested, so that what runs here runs in a
//! browser too; except for the size of buffers, which natively is the driver's limit, and subgroups, where available.

use super::tuning::Tuning;
use crate::{Error, ErrorKind, Result};
use std::future::Future;
use std::pin::pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Waker};

/// Kinds of adapters that will do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Adapters {
    /// Only a GPU: a driver that computes on the CPU is no faster than the CPU renderer.
    Hardware,
    /// A GPU if there is one, else a driver that computes on the CPU (Mesa's lavapipe).
    Any,
}

/// Threads of the smallest and the largest subgroup that kernels can work with (rasterize_back_subgroup.wgsl).
pub(super) const SUBGROUPS: [u32; 2] = [8, 64];

/// The first error that the driver reported since it was last requested.
type Trouble = Arc<Mutex<Option<(ErrorKind, String)>>>;

/// An open GPU.
#[derive(Debug)]
pub struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    /// Of the kernels that are compiled for it.
    pub(super) tuning: Tuning,
    /// Buffers for which there is no memory, as tests request.
    pub(super) refused: Option<&'static str>,
    info: wgpu::AdapterInfo,
    trouble: Trouble,
}

impl Gpu {
    /// Opens the best adapter: discrete before integrated, hardware before software.
    ///
    /// Errors: there is none (the message states what was found), or its driver refuses WebGPU's default limits.
    pub fn open(adapters: Adapters) -> Result<Self> {
        Self::open_within(adapters, u64::MAX)
    }

    /// The same, with no buffer larger than this many bytes, whatever the driver has.
    pub(super) fn open_within(adapters: Adapters, most: u64) -> Result<Self> {
        let mut found = all_adapters();
        found.retain(|a| adapters == Adapters::Any || a.get_info().device_type != wgpu::DeviceType::Cpu);
        let Some(adapter) = found.into_iter().min_by_key(|a| rank(a.get_info().device_type)) else {
            let software = adapters == Adapters::Hardware && !all_adapters().is_empty();
            let what = if software {
                "no GPU found, only a driver that computes on the CPU"
            } else {
                "no Vulkan, Metal or Direct3D 12 driver was found"
            };
            return Err(
                Error::new(ErrorKind::Unsupported, what).remedy("Install the graphics card's driver, or use the CPU.")
            );
        };
        let info = adapter.get_info();
        let refused = |e: wgpu::RequestDeviceError| {
            Error::new(ErrorKind::Unsupported, format!("the GPU cannot be opened ({e})"))
                .at(&info.name)
                .remedy("Free its memory, update its driver, or use the CPU.")
        };
        let (own, least) = (adapter.limits(), wgpu::Limits::default());
        if let Some(what) = lacking(&own) {
            return Err(Error::new(ErrorKind::Unsupported, what)
                .at(&info.name)
                .remedy("Update its driver, or use the CPU."));
        }
        let limits = wgpu::Limits {
            max_buffer_size: own.max_buffer_size.max(least.max_buffer_size).min(most),
            max_storage_buffer_binding_size: own
                .max_storage_buffer_binding_size
                .max(least.max_storage_buffer_binding_size)
                .min(most),
            ..least
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("splat4d"),
            required_features: adapter.features() & (wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::SUBGROUP),
            required_limits: limits,
            ..Default::default()
        };
        let (device, queue) = block_on(adapter.request_device(&descriptor)).map_err(refused)?;
        let trouble = Trouble::default();
        let first = Arc::clone(&trouble);
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| {
            let kind = match &e {
                wgpu::Error::OutOfMemory { .. } => ErrorKind::Memory,
                _ => ErrorKind::Unsupported,
            };
            first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert((kind, e.to_string()));
        }));
        Ok(Self { device, queue, tuning: Tuning::default(), refused: None, info, trouble })
    }

    /// The same with other constants in the kernels that are compiled from now on.
    #[must_use]
    pub fn tuned(self, tuning: Tuning) -> Self {
        Self { tuning, ..self }
    }

    /// The adapter's name from its driver.
    pub(crate) fn name(&self) -> &str {
        &self.info.name
    }

    /// Adapter, kind, interface and driver in one line, and whether kernels use its subgroups.
    pub fn describe(&self) -> String {
        let i = &self.info;
        let driver = [i.driver.as_str(), i.driver_info.as_str()].join(" ");
        let with = if self.has_subgroups() { ", with subgroups" } else { "" };
        format!("{} ({:?}, {}, {}{with})", i.name, i.device_type, i.backend, driver.trim())
    }

    /// Whether it has memory that is not the CPU's.
    pub(super) fn has_own_memory(&self) -> bool {
        self.info.device_type == wgpu::DeviceType::DiscreteGpu
    }

    /// Whether the GPU's own clock can be read.
    pub(crate) fn has_timestamps(&self) -> bool {
        self.device.features().contains(wgpu::Features::TIMESTAMP_QUERY)
    }

    /// Threads of the smallest subgroup that the device may choose.
    pub(super) fn smallest_subgroup(&self) -> usize {
        self.info.subgroup_min_size as usize
    }

    /// Whether kernels are compiled that exchange numbers within subgroups.
    pub(crate) fn has_subgroups(&self) -> bool {
        let fits = self.info.subgroup_min_size >= SUBGROUPS[0] && self.info.subgroup_max_size <= SUBGROUPS[1];
        self.tuning.subgroups && fits && self.device.features().contains(wgpu::Features::SUBGROUP)
    }

    /// Splats of a bucket of the backward pass with a lane per splat: the threads of the smallest subgroup, so that a
    /// workgroup of as many lies in one. 0: the backward pass has another form.
    pub(super) fn lanes(&self) -> usize {
        if self.tuning.back_lanes && self.has_subgroups() { self.smallest_subgroup() } else { 0 }
    }

    /// Waits until all work has been done.
    pub(super) fn wait(&self) -> Result<()> {
        self.poll(wgpu::PollType::wait_indefinitely())
    }

    /// Waits until the given work is done, and not for later work.
    pub(super) fn wait_for(&self, work: &wgpu::SubmissionIndex) -> Result<()> {
        self.poll(wgpu::PollType::Wait { submission_index: Some(work.clone()), timeout: None })
    }

    fn poll(&self, until: wgpu::PollType) -> Result<()> {
        self.device.poll(until).map_err(|e| self.error(ErrorKind::Unsupported, e.to_string()))?;
        self.check()
    }

    /// The first error that was reported since the last call.
    pub(super) fn check(&self) -> Result<()> {
        match self.trouble.lock().unwrap_or_else(PoisonError::into_inner).take() {
            None => Ok(()),
            Some((kind, text)) => Err(self.error(kind, text)),
        }
    }

    pub(super) fn error(&self, kind: ErrorKind, text: String) -> Error {
        let what = match kind {
            ErrorKind::Memory => "the GPU has too little memory",
            _ => "the GPU's driver failed",
        };
        Error::new(kind, format!("{what} ({text})")).at(&self.info.name).remedy("Render on the CPU.")
    }
}

/// Every adapter of this machine. Validation of indirect dispatches is left out: our own kernels write their sizes,
/// and the check costs a dispatch each.
fn all_adapters() -> Vec<wgpu::Adapter> {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::PRIMARY;
    descriptor.flags = wgpu::InstanceFlags::from_build_config() - wgpu::InstanceFlags::VALIDATION_INDIRECT_CALL;
    block_on(wgpu::Instance::new(descriptor).enumerate_adapters(wgpu::Backends::PRIMARY))
}

/// The first of WebGPU's default limits that a driver does not have.
fn lacking(own: &wgpu::Limits) -> Option<String> {
    let mut first = None;
    wgpu::Limits::default().check_limits_with_fail_fn(own, true, |limit, needed, allowed| {
        first = Some(format!("the GPU's driver allows {allowed} of `{limit}`, {needed} are needed"));
    });
    first
}

fn rank(kind: wgpu::DeviceType) -> u8 {
    match kind {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    }
}

/// Waits for a future. Natively wgpu's are ready at once; a thread that yields is enough for any that is not.
fn block_on<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    let mut context = Context::from_waker(Waker::noop());
    loop {
        if let Poll::Ready(value) = future.as_mut().poll(&mut context) {
            return value;
        }
        std::thread::yield_now();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_that_a_driver_lacks_is_named() {
        let own = wgpu::Limits::default();
        assert_eq!(lacking(&own), None);
        let poor = wgpu::Limits { max_storage_buffers_per_shader_stage: 4, ..own };
        let what = lacking(&poor).expect("four are too few");
        assert!(what.contains("4 of `max_storage_buffers_per_shader_stage`, 8 are needed"), "{what}");
    }
}

//! The cameras' colour matrices, as in record.wgsl.

use crate::Result;
use crate::gpu::buffers::Grown;
use crate::gpu::compare::RESPONSES;
use crate::gpu::device::Gpu;
use crate::render::ResidentCameras;
use crate::scene::BLOCK;

/// Matrices, gradients, first and second moments; then a step count and a mark per camera.
const PARTS: usize = 4;

/// See the module's documentation.
#[derive(Debug)]
pub(super) struct Cameras {
    count: usize,
    buffer: Grown,
}

/// Place of a number in a table of this many columns.
fn place(row: usize, column: usize, width: usize) -> usize {
    (row / BLOCK * width + column) * BLOCK + row % BLOCK
}

impl Cameras {
    /// None.
    pub(super) fn new() -> Self {
        Self { count: 0, buffer: Grown::storage("the cameras' colours") }
    }

    /// Count.
    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// All of their numbers.
    pub(super) fn buffer(&self) -> &Grown {
        &self.buffer
    }

    /// Count of these.
    pub(super) fn numbers(&self) -> usize {
        self.count * (PARTS * RESPONSES + 2)
    }

    /// Takes them over. Errors: no memory.
    pub(super) fn keep(&mut self, gpu: &Gpu, cameras: Option<&ResidentCameras<'_>>) -> Result<()> {
        self.count = cameras.map_or(0, |c| c.count);
        let mut all = vec![0.0; self.numbers()];
        if let Some(cameras) = cameras {
            let width = 2 * RESPONSES + 1;
            for camera in 0..self.count {
                for c in 0..RESPONSES {
                    let to = |part: usize| (part * self.count + camera) * RESPONSES + c;
                    all[to(0)] = cameras.table.params[place(camera, c, RESPONSES)];
                    if !cameras.table.moments.is_empty() {
                        all[to(2)] = cameras.table.moments[place(camera, c, width)];
                        all[to(3)] = cameras.table.moments[place(camera, RESPONSES + c, width)];
                    }
                }
                if !cameras.table.moments.is_empty() {
                    all[PARTS * RESPONSES * self.count + camera] =
                        cameras.table.moments[place(camera, 2 * RESPONSES, width)];
                }
            }
            for &camera in cameras.held {
                all[(PARTS * RESPONSES + 1) * self.count + camera] = 1.0;
            }
        }
        super::send(gpu, &mut self.buffer, &all)
    }

    /// The table and its moments, from all numbers.
    pub(super) fn apart(&self, all: &[f32]) -> [Vec<f32>; 2] {
        let (rows, width) = (self.count.next_multiple_of(BLOCK), 2 * RESPONSES + 1);
        let (mut params, mut moments) = (vec![0.0; rows * RESPONSES], vec![0.0; rows * width]);
        for camera in 0..self.count {
            for c in 0..RESPONSES {
                let from = |part: usize| all[(part * self.count + camera) * RESPONSES + c];
                params[place(camera, c, RESPONSES)] = from(0);
                moments[place(camera, c, width)] = from(2);
                moments[place(camera, RESPONSES + c, width)] = from(3);
            }
            moments[place(camera, 2 * RESPONSES, width)] = all[PARTS * RESPONSES * self.count + camera];
        }
        [params, moments]
    }
}

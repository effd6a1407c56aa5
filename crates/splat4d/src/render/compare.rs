//! A comparison of an image on a device, and its result.

use crate::scene::Planes;

/// Truth and weights of a comparison: the loss of 3DGS, (1 − λ)·L1 + λ·(1 − SSIM), as plain data.
#[derive(Clone, Copy, Debug)]
pub struct Target<'a, F = f32> {
    /// The truth, [3, h, w].
    pub truth: &'a Planes<F>,
    /// Weights of pixels, ≥ 0, [1, h, w]; one of weight 0 is as one outside of the image. None: 1.
    pub weight: Option<&'a Planes<F>>,
    /// The truth's number: under one number and size there is always the same truth, which a device may keep.
    pub picture: usize,
    /// λ: the share of 1 − SSIM.
    pub dssim: f64,
    /// How the camera shows what is rendered: a matrix without the identity, row by row, then an offset per channel.
    pub response: Option<[F; 12]>,
}

/// The result of a comparison, its means weighted.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Comparison {
    /// Mean |image − truth| over pixels and channels.
    pub l1: f64,
    /// Mean of the SSIM map.
    pub ssim: f64,
    /// Mean of (image − truth)², the image clamped to [0, 1].
    pub mse: f64,
    /// Gradient to the camera's response, where there is one.
    pub d_response: Option<[f64; 12]>,
}

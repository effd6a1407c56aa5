// Constants that several modules need: of the clock, of the renderer, of spherical harmonics.

/// Slowest and fastest speed of a clock.
export const SPEED_RANGE = [0.1, 4];
/// Longest step of a playing clock, s: a page that was hidden or blocked for longer continues where it was.
export const STEP_MAX = 1;
/// Added to the variances of a Gaussian in the image, px² (Kerbl et al. 2023).
export const LOW_PASS = 0.3;
/// Standard deviations from its centre at which an opaque Gaussian falls to 1/255.
export const ALPHA_SPAN = Math.sqrt(2 * Math.log(255));
/// Factors of the real spherical harmonics of degrees 1 to 3, in the order of docs/format.md, "Palette": degree 1; xy,
/// yz and xz of degree 2; 2z² − x² − y²; x² − y²; of degree 3 the orders ±3, −2, ±1, 0 and 2.
export const SH = {
  first: 0.4886025119029199,
  product: 1.0925484305920792,
  axial: 0.31539156525252005,
  difference: 0.5462742152960396,
  third: 0.5900435899266435,
  triple: 2.890611442640554,
  side: 0.4570457994644658,
  pole: 0.3731763325901154,
  cone: 1.445305721320277,
};

// Random playback pages, as SceneFile gives them: repeatable, with every edge code of docs/format.md among them.

/// Uniform numbers in [0, 1) from a seed (mulberry32).
export function random(seed) {
  let a = seed >>> 0;
  return () => {
    a = (a + 0x6d2b79f5) >>> 0;
    let t = Math.imul(a ^ (a >>> 15), a | 1);
    t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  };
}

/// A page of `count` Gaussians in a cube of half-width `size`; `logScale` [min, max] of its standard deviations.
/// `edges`: extreme codes turn up often.
export function page(id, count, { from, to, tier = 0, palette = -1, entries = 1, seed = id + 1, size = 1,
  logScale = [-4.5, -2.5], opacity = [20, 255], edges = false, forever = 0.3 }) {
  const r = random(seed), int = (n) => Math.floor(r() * n);
  const blocks = Math.ceil(count / 256), headers = new Float32Array(24 * blocks);
  for (let k = 0; k < blocks; k++) {
    const low = [0, 1, 2].map(() => -size * (0.3 + 0.7 * r()));
    headers.set([...low, ...low.map((v) => v + size * (0.5 + r())), from - 0.1, to + 0.1, from - 9, to + 9,
      ...logScale, 0.2 * size, 0.8, Math.log(0.05), Math.log((to - from) / 2), Math.log(0.02), Math.log(0.3),
      0.1, 0, 0.05, 1, 0.9, 0.8], 24 * k);
  }
  const pick = (n) => (edges && r() < 0.3 ? [0, 1, n - 2, n - 1, n >> 1][int(5)] : int(n));
  const words = new Uint32Array(8 * count);
  for (let i = 0; i < count; i++) {
    const three = (n, bits) => pick(n) | pick(n) << bits | pick(n) << 2 * bits;
    const half = r() < forever ? 255 : pick(256);
    const alpha = opacity[0] + int(opacity[1] - opacity[0] + 1);
    words.set([
      pick(65536) | pick(65536) << 16, pick(65536) | pick(65536) << 16, three(256, 8) | alpha << 24,
      // Components above 1/√3 in all three places would leave none for the largest: keep some of them sound.
      (edges ? three(1024, 10) : [0, 10, 20].reduce((s, at) => s | (100 + int(822)) << at, 0)) | int(4) << 30,
      three(1024, 10), three(1024, 10), three(256, 8) | half << 24, int(entries) | pick(256) << 16,
    ], 8 * i);
  }
  return { page: { id, count, headers, words }, entry: { from, to, tier, palette } };
}

/// A palette of random codes.
export function palette(id, degree, count, seed = 77) {
  const r = random(seed), bytes = new Uint8Array(3 * ((degree + 1) ** 2 - 1) * count);
  for (let i = 0; i < bytes.length; i++) bytes[i] = Math.floor(r() * 256);
  return { id, degree, count, ranges: new Float32Array([0.25, 0.15, 0.1]), bytes };
}

/// A camera at `eye` that looks at the origin, y of the world up.
export function view(eye, width, height, focal) {
  const unit = (v) => v.map((x) => x / Math.hypot(...v));
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const z = unit(eye.map((v) => -v)), x = unit(cross(z, [0, 1, 0])), y = cross(z, x);
  const rows = [x, y, z].map((a) => [...a, -a.reduce((s, v, k) => s + v * eye[k], 0)]);
  return { cameraFromWorld: Float64Array.from(rows.flat()), fx: focal, fy: 1.02 * focal, cx: 0.48 * width,
    cy: 0.53 * height, width, height };
}

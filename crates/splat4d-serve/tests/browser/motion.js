// docs/format.md in f64: one Gaussian of a page, and where it is at a time. The shaders are its twins.

import '../../player/sort.worker.js';

const { ALPHA_MIN, lerp, path, signed10 } = globalThis.splat4dSort;

const BLOCK = 256,
  HEADER = 24,
  WORDS = 8;

/// Gaussian `i` of a decoded page: {mean, center, velocity, half, soft, opacity, reach, scale, quat wxyz, spin (angular
/// velocity), color, label}. `entry` is its section: its span decides about rates.
export function gaussian(page, entry, i) {
  const { words, headers } = page,
    p = new Float64Array(11);
  path(words, headers, i, entry.to - entry.from, p);
  const h = headers.subarray(HEADER * Math.floor(i / BLOCK)),
    w = words.subarray(WORDS * i, WORDS * i + WORDS);
  const byte = (word, k) => ((w[word] >>> (8 * k)) & 255) / 255;
  const largest = w[3] >>> 30,
    quat = [0, 0, 0, 0];
  let rest = 1,
    bit = 20;
  for (let k = 0; k < 4; k++) {
    if (k === largest) continue;
    quat[k] = signed10(w[3], bit) * Math.SQRT1_2;
    rest -= quat[k] ** 2;
    bit -= 10;
  }
  quat[largest] = Math.sqrt(Math.max(rest, 0));
  return {
    mean: [p[0], p[1], p[2]],
    center: p[3],
    velocity: [p[4], p[5], p[6]],
    half: p[7],
    soft: p[8],
    opacity: p[9],
    reach: p[10],
    scale: [0, 1, 2].map((k) => Math.exp(lerp(h[10], h[11], byte(2, k)))),
    quat,
    spin: [0, 10, 20].map((b) => (signed10(w[5], b) * h[13]) / p[10]),
    color: [0, 1, 2].map((k) => lerp(h[18 + k], h[21 + k], byte(6, k))),
    label: w[7] & 0xffff,
  };
}

/// Where Gaussian `g` is at `time`: {mean, quat, opacity: with its lifespan; 0 where it is not drawn}.
export function at(g, time) {
  const dt = time - g.center;
  const mean = g.mean.map((x, k) => x + g.velocity[k] * dt);
  const [w, x, y, z] = g.quat,
    [a, b, c] = g.spin.map((v) => (v * dt) / 2);
  const turned = [
    w - a * x - b * y - c * z,
    x + a * w + b * z - c * y,
    y + b * w + c * x - a * z,
    z + c * w + a * y - b * x,
  ];
  const length = Math.hypot(...turned);
  const out = g.half === Infinity ? 0 : Math.max(0, Math.abs(dt) - g.half) / g.soft;
  const opacity = g.opacity * Math.exp(-0.5 * out * out);
  return { mean, quat: turned.map((v) => v / length), opacity: opacity < ALPHA_MIN ? 0 : opacity };
}

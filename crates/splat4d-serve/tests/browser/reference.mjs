// A renderer in f64, slow and plain, from CONVENTIONS.md: what the player's images are compared with.

const SH = [
  ([, y]) => -0.4886025119029199 * y,
  ([, , z]) => 0.4886025119029199 * z,
  ([x]) => -0.4886025119029199 * x,
  ([x, y]) => 1.0925484305920792 * x * y,
  ([, y, z]) => -1.0925484305920792 * y * z,
  ([x, y, z]) => 0.31539156525252005 * (2 * z * z - x * x - y * y),
  ([x, , z]) => -1.0925484305920792 * x * z,
  ([x, y]) => 0.5462742152960396 * (x * x - y * y),
  ([x, y]) => -0.5900435899266435 * y * (3 * x * x - y * y),
  ([x, y, z]) => 2.890611442640554 * x * y * z,
  ([x, y, z]) => -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
  ([x, y, z]) => 0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
  ([x, y, z]) => -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
  ([x, y, z]) => 1.445305721320277 * z * (x * x - y * y),
  ([x, y]) => -0.5900435899266435 * x * (x * x - 3 * y * y),
];
const dot = (a, b) => a.reduce((s, v, i) => s + v * b[i], 0);

/// Where a Gaussian of sample.mjs is at `t`: {mean, rotation rows, opacity}, or null. `admitted(t)`, where it has that,
/// is what key masks say.
export function moved(g, t) {
  if (!(g.span[0] <= t && t < g.span[1]) || g.admitted?.(t) === false) return null;
  const dt = t - g.center,
    out = g.half === Infinity ? 0 : Math.max(0, Math.abs(dt) - g.half) / g.soft;
  const opacity = g.opacity * Math.exp(-0.5 * out * out);
  if (opacity < 1 / 255) return null;
  const [w, x, y, z] = g.quat,
    [a, b, c] = g.spin.map((v) => (v * dt) / 2);
  const q = [
    w - a * x - b * y - c * z,
    x + a * w + b * z - c * y,
    y + b * w + c * x - a * z,
    z + c * w + a * y - b * x,
  ];
  const [r, i, j, k] = q.map((v) => v / Math.hypot(...q));
  return {
    opacity,
    mean: g.mean.map((m, n) => m + g.velocity[n] * dt),
    rotation: [
      [1 - 2 * (j * j + k * k), 2 * (i * j - r * k), 2 * (i * k + r * j)],
      [2 * (i * j + r * k), 1 - 2 * (i * i + k * k), 2 * (j * k - r * i)],
      [2 * (i * k - r * j), 2 * (j * k + r * i), 1 - 2 * (i * i + j * j)],
    ],
  };
}

/// RGBA bytes, rows from the top, of the truth of sample.mjs (or anything like it) at `time` seen by `view`.
export function render(
  truth,
  time,
  view,
  { background = [0, 0, 0], channel = 'color', depthRange = [0, 1], flowScale = 100 } = {},
) {
  const { width, height, fx, fy, cx, cy, cameraFromWorld: m } = view,
    R = [0, 4, 8].map((o) => [m[o], m[o + 1], m[o + 2]]);
  const T = [m[3], m[7], m[11]],
    eye = [0, 1, 2].map((i) => -dot([R[0][i], R[1][i], R[2][i]], T)),
    splats = [];
  for (const g of truth) {
    const now = moved(g, time);
    if (!now) continue;
    const p = R.map((row, k) => dot(row, now.mean) + T[k]);
    if (p[2] <= 0.01) continue;
    const margin = [(0.15 * width) / fx, (0.15 * height) / fy];
    const u = [
      Math.min(Math.max(p[0] / p[2], -cx / fx - margin[0]), (width - cx) / fx + margin[0]),
      Math.min(Math.max(p[1] / p[2], -cy / fy - margin[1]), (height - cy) / fy + margin[1]),
    ];
    const J = [
      [fx / p[2], 0, (-fx * u[0]) / p[2]],
      [0, fy / p[2], (-fy * u[1]) / p[2]],
    ];
    const JW = J.map((row) => [0, 1, 2].map((i) => dot(row, [R[0][i], R[1][i], R[2][i]])));
    const L = JW.map((row) =>
      [0, 1, 2].map(
        (i) =>
          dot(
            row,
            now.rotation.map((r) => r[i]),
          ) * g.scale[i],
      ),
    );
    const [xx, xy, yy] = [dot(L[0], L[0]) + 0.3, dot(L[0], L[1]), dot(L[1], L[1]) + 0.3],
      det = xx * yy - xy * xy;
    const direction = now.mean.map((v, i) => v - eye[i]),
      length = Math.hypot(...direction);
    const d = direction.map((v) => v / length);
    const color = [0, 1, 2].map((c) => Math.max(0, g.color[c] + g.sh.reduce((s, f, k) => s + SH[k](d) * f[c], 0)));
    const v = R.map((row) => dot(row, g.velocity));
    const flow = [(fx * (v[0] - (p[0] / p[2]) * v[2])) / p[2], (fy * (v[1] - (p[1] / p[2]) * v[2])) / p[2]];
    splats.push({
      depth: p[2],
      at: [(fx * p[0]) / p[2] + cx, (fy * p[1]) / p[2] + cy],
      conic: [yy / det, -xy / det, xx / det],
      half: [xx, yy],
      opacity: now.opacity,
      value: channel === 'color' ? color : channel === 'flow' ? hue(flow, flowScale) : [p[2], p[2], p[2]],
    });
  }
  splats.sort((a, b) => a.depth - b.depth);
  const left = new Float64Array(width * height).fill(1),
    sums = new Float64Array(3 * width * height);
  for (const s of splats) {
    // Outside this box α < 1/255; a pixel more on each side, as the test below decides.
    const [ex, ey] = s.half.map((v) => Math.sqrt(2 * Math.log(255 * s.opacity) * v) + 1);
    for (let y = Math.max(0, Math.floor(s.at[1] - ey)); y < Math.min(height, s.at[1] + ey); y++) {
      for (let x = Math.max(0, Math.floor(s.at[0] - ex)); x < Math.min(width, s.at[0] + ex); x++) {
        const i = y * width + x,
          [dx, dy] = [x + 0.5 - s.at[0], y + 0.5 - s.at[1]];
        const raw = s.opacity * Math.exp(-0.5 * (s.conic[0] * dx * dx + s.conic[2] * dy * dy) - s.conic[1] * dx * dy);
        if (raw < 1 / 255) continue;
        const alpha = Math.min(0.99, raw);
        if (left[i] * (1 - alpha) < 1e-4) continue;
        for (let c = 0; c < 3; c++) sums[3 * i + c] += left[i] * alpha * s.value[c];
        left[i] *= 1 - alpha;
      }
    }
  }
  const data = new Uint8ClampedArray(4 * width * height);
  for (let i = 0; i < left.length; i++) {
    const sum = [...sums.subarray(3 * i, 3 * i + 3)],
      alpha = 1 - left[i];
    let rgb = sum.map((v, c) => v + left[i] * background[c]);
    if (channel === 'alpha') rgb = [alpha, alpha, alpha];
    if (channel === 'depth') {
      rgb = alpha < 0.5 ? [0, 0, 0] : sum.map((v) => 1 - (v / alpha - depthRange[0]) / (depthRange[1] - depthRange[0]));
    }
    rgb.forEach((v, c) => (data[4 * i + c] = 255 * Math.min(Math.max(v, 0), 1)));
    data[4 * i + 3] = 255;
  }
  return data;
}

/// Direction as hue, speed as value.
function hue([x, y], scale) {
  const h = (((Math.atan2(y, x) / (2 * Math.PI)) % 1) + 1) % 1,
    value = Math.min(Math.hypot(x, y) / scale, 1);
  return [0, 2 / 3, 1 / 3].map((o) => value * Math.min(Math.max(Math.abs(((h + o) % 1) * 6 - 3) - 1, 0), 1));
}

/// PSNR of two RGBA images, alpha left out, dB.
export function psnr(a, b) {
  let sum = 0;
  for (let i = 0; i < a.length; i++) if (i % 4 < 3) sum += (a[i] - b[i]) ** 2;
  return 10 * Math.log10((255 * 255 * (0.75 * a.length)) / sum);
}

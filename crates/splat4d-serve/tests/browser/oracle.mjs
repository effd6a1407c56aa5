// docs/format.md and CONVENTIONS.md in plain f64, as slow and as direct as they read: what the backends are tested
// against. Shares no code with the player.

const Y00 = 0.28209479177387814;
const ALPHA_MIN = 1 / 255;
const ALPHA_MAX = 0.99;
const NEAR = 0.01;
const LOW_PASS = 0.3;
const J_MARGIN = 0.3;

/// One Gaussian at time t. `f`: the block's 24 numbers, `w`: its 8 words, `span`: to - from of its page.
export function gaussian(f, w, span, t) {
  const lerp = (a, b, u) => a + (b - a) * u;
  const bits = (word, at, n) => Math.floor(word / 2 ** at) % 2 ** n;
  const ten = (word) => [0, 10, 20].map((at) => (bits(word, at, 10) - 511) / 511);
  const codes = [bits(w[0], 0, 16), bits(w[0], 16, 16), bits(w[1], 0, 16)];
  const center = lerp(f[6], f[7], bits(w[1], 16, 16) / 65535);
  const h = bits(w[6], 24, 8);
  const half = h === 0 || h === 255 ? 0 : Math.exp(lerp(f[14], f[15], (h - 1) / 253));
  const soft = Math.exp(lerp(f[16], f[17], bits(w[7], 16, 8) / 255));
  const reach = h === 255 ? span / 2 : Math.min(half + 3 * soft, span);
  const delta = t - center;
  const sigma = h === 255 ? 1 : Math.exp(-0.5 * (Math.max(0, Math.abs(delta) - half) / soft) ** 2);
  const velocity = ten(w[4]).map((v) => f[12] * v / reach);
  const omega = ten(w[5]).map((v) => f[13] * v / reach);
  const others = [20, 10, 0].map((at) => (bits(w[3], at, 10) - 511) / 511 / Math.SQRT2);
  const q0 = others.slice();
  q0.splice(bits(w[3], 30, 2), 0, Math.sqrt(Math.max(0, 1 - others.reduce((s, v) => s + v * v, 0))));
  // (0, ω) ⊗ q0
  const [a, x, y, z] = q0, [p, q, r] = omega;
  const turn = [-p * x - q * y - r * z, p * a + q * z - r * y, q * a + r * x - p * z, r * a + p * y - q * x];
  const raw = q0.map((v, i) => v + 0.5 * delta * turn[i]);
  const norm = Math.hypot(...raw);
  return {
    mean: [0, 1, 2].map((k) => lerp(f[k], f[3 + k], codes[k] / 65535) + velocity[k] * delta),
    quat: raw.map((v) => v / norm),
    scale: [0, 8, 16].map((at) => Math.exp(lerp(f[10], f[11], bits(w[2], at, 8) / 255))),
    opacity: bits(w[2], 24, 8) / 255 * sigma,
    velocity,
    base: [0, 1, 2].map((k) => lerp(f[18 + k], f[21 + k], bits(w[6], 8 * k, 8) / 255)),
    label: bits(w[7], 0, 16),
  };
}

/// Real spherical harmonics 1 to 15, signs of 3DGS.
function harmonics([x, y, z]) {
  const [xx, yy, zz] = [x * x, y * y, z * z], c1 = Math.sqrt(3) * Y00;
  const a = Math.sqrt(15) * Y00, b = Math.sqrt(5) / 2 * Y00;
  const c = [Math.sqrt(70) / 4, Math.sqrt(105), Math.sqrt(42) / 4, Math.sqrt(7) / 2].map((v) => v * Y00);
  return [
    -c1 * y, c1 * z, -c1 * x,
    a * x * y, -a * y * z, b * (2 * zz - xx - yy), -a * x * z, a / 2 * (xx - yy),
    -c[0] * y * (3 * xx - yy), c[1] * x * y * z, -c[2] * y * (4 * zz - xx - yy),
    c[3] * z * (2 * zz - 3 * xx - 3 * yy), -c[2] * x * (4 * zz - xx - yy), c[1] / 2 * z * (xx - yy),
    -c[0] * x * (xx - 3 * yy),
  ];
}

/// Hue from the direction (right red, down the screen yellow-green), value from the speed.
function flowColor([vx, vy], scale) {
  const hue = (Math.atan2(vy, vx) / (2 * Math.PI) + 1) % 1 * 6;
  const value = Math.min(1, Math.hypot(vx, vy) / scale);
  return [0, 4, 2].map((n) => value * Math.min(1, Math.max(0, Math.abs((hue + n) % 6 - 3) - 1)));
}

/// Everything that can be seen of `pages` ({page, entry, palette}) at time t, nearest first.
export function project(pages, view, t) {
  const m = view.cameraFromWorld, out = [];
  const eye = [0, 1, 2].map((c) => -(m[c] * m[3] + m[4 + c] * m[7] + m[8 + c] * m[11]));
  let id = 0;
  for (const { page, entry, palette } of pages) {
    if (!(entry.from <= t && t < entry.to)) continue;
    for (let i = 0; i < page.count; i++, id++) {
      const block = i >> 8, f = page.headers.subarray(24 * block, 24 * block + 24);
      const g = gaussian(f, page.words.subarray(8 * i, 8 * i + 8), entry.to - entry.from, t);
      const p = [0, 1, 2].map((r) => m[4 * r] * g.mean[0] + m[4 * r + 1] * g.mean[1] + m[4 * r + 2] * g.mean[2]
        + m[4 * r + 3]);
      if (!(p[2] > NEAR) || g.opacity < ALPHA_MIN) continue;
      const focal = [view.fx, view.fy], middle = [view.cx, view.cy], size = [view.width, view.height];
      const uv = [p[0] / p[2], p[1] / p[2]];
      const held = uv.map((v, k) => {
        const margin = J_MARGIN * 0.5 * size[k] / focal[k];
        return Math.min((size[k] - middle[k]) / focal[k] + margin, Math.max(v, -(middle[k] / focal[k] + margin)));
      });
      const [w, x, y, z] = g.quat;
      const R = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
      ];
      // J W R S: two rows.
      const rows = [0, 1].map((k) => [0, 1, 2].map((j) => g.scale[j] * [0, 1, 2].reduce((s, c) =>
        s + focal[k] / p[2] * (m[4 * k + c] - held[k] * m[8 + c]) * R[c][j], 0)));
      const dot = (a, b) => a.reduce((s, v, k) => s + v * b[k], 0);
      const cov = [dot(rows[0], rows[0]) + LOW_PASS, dot(rows[0], rows[1]), dot(rows[1], rows[1]) + LOW_PASS];
      const det = cov[0] * cov[2] - cov[1] * cov[1];
      const toward = g.mean.map((v, k) => v - eye[k]), far = Math.hypot(...toward);
      const rgb = g.base.slice();
      if (palette) {
        const Y = harmonics(toward.map((v) => v / far));
        for (let k = 1; k < (palette.degree + 1) ** 2; k++) {
          const l = k < 4 ? 0 : k < 9 ? 1 : 2;
          for (let c = 0; c < 3; c++) {
            const code = palette.bytes[(3 * (k - 1) + c) * palette.count + g.label];
            rgb[c] += Y[k - 1] * palette.ranges[l] * (code - 128) / 127;
          }
        }
      }
      const v = [0, 1, 2].map((r) => m[4 * r] * g.velocity[0] + m[4 * r + 1] * g.velocity[1]
        + m[4 * r + 2] * g.velocity[2]);
      out.push({
        id, depth: p[2], opacity: g.opacity, rgb: rgb.map((c) => Math.max(0, c)),
        at: uv.map((c, k) => focal[k] * c + middle[k]),
        conic: [cov[2] / det, -cov[1] / det, cov[0] / det],
        extent: [cov[0], cov[2]].map((c) => Math.sqrt(2 * Math.log(g.opacity / ALPHA_MIN) * c)),
        flow: [0, 1].map((k) => focal[k] * (v[k] - uv[k] * v[2]) / p[2]),
      });
    }
  }
  return out.sort((a, b) => a.depth - b.depth || a.id - b.id);
}

/// The picture as a backend's readPixels gives it: RGBA, 8 bits.
export function render(pages, { time, view, channel = 'color', background, depthRange = [0, 1], flowScale = 1 }) {
  const { width, height } = view, sum = new Float64Array(4 * width * height).fill(0), T = new Float64Array(width * height);
  T.fill(1);
  for (const s of project(pages, view, time)) {
    const value = channel === 'flow' ? flowColor(s.flow, flowScale) : channel === 'depth' ? Array(3).fill(s.depth) : s.rgb;
    const y0 = Math.max(0, Math.ceil(s.at[1] - s.extent[1] - 0.5)), x0 = Math.max(0, Math.ceil(s.at[0] - s.extent[0] - 0.5));
    for (let y = y0; y < height && y + 0.5 <= s.at[1] + s.extent[1]; y++) {
      for (let x = x0; x < width && x + 0.5 <= s.at[0] + s.extent[0]; x++) {
        const [dx, dy] = [x + 0.5 - s.at[0], y + 0.5 - s.at[1]], i = y * width + x;
        const q = s.conic[0] * dx * dx + 2 * s.conic[1] * dx * dy + s.conic[2] * dy * dy;
        const alpha = Math.min(ALPHA_MAX, s.opacity * Math.exp(-0.5 * q));
        if (alpha < ALPHA_MIN) continue;
        for (let c = 0; c < 3; c++) sum[4 * i + c] += value[c] * alpha * T[i];
        T[i] *= 1 - alpha;
      }
    }
  }
  const data = new Uint8ClampedArray(4 * width * height);
  for (let i = 0; i < width * height; i++) {
    for (let c = 0; c < 3; c++) {
      let v = sum[4 * i + c] + background[c] * T[i];
      if (channel === 'alpha') v = 1 - T[i];
      if (channel === 'depth') {
        const mean = sum[4 * i + c] / (1 - T[i]);
        v = T[i] > 0.5 ? 0 : 1 - (mean - depthRange[0]) / (depthRange[1] - depthRange[0]);
      }
      data[4 * i + c] = 255 * v;
    }
    data[4 * i + 3] = 255;
  }
  return { width, height, data };
}

/// PSNR of two pictures' colours, dB.
export function psnr(a, b) {
  let sum = 0, n = 0;
  for (let i = 0; i < a.length; i++) {
    if (i % 4 === 3) continue;
    sum += (a[i] - b[i]) ** 2;
    n++;
  }
  return 10 * Math.log10(255 * 255 / (sum / n));
}

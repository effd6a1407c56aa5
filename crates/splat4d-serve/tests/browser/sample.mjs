// Writes a playback file from docs/format.md alone, with nothing of the player's or the crate's: so that the page, the
// Rust writer and the player's reader check each other. The scene is made of random codes; `truth` is what they mean.

import { crc32, deflateRawSync } from 'node:zlib';

/// A repeatable stream of numbers in [0, 1): Mulberry32.
export function random(seed) {
  return () => {
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  };
}

// zlib.crc32 came with Node 20.15 and 22.2.
const crc = (bytes) => crc32(bytes) >>> 0;
const lerp = (a, b, u) => a + (b - a) * u;

/// A page of `n` random Gaussians: {data: decoded bytes, truth: their meaning}. `span` [from, to], `entries` of its
/// palette.
function page(next, n, span, { entries = 0, scale, center, extent }) {
  const code = (bits) => Math.floor(next() * 2 ** bits);
  const blocks = Math.ceil(n / 256),
    data = Buffer.alloc(blocks * 96 + 32 * n),
    truth = [];
  for (let b = 0; b < blocks; b++) {
    const h = new Float32Array(24);
    const middle = center.map((c) => c + (next() - 0.5) * extent);
    for (let k = 0; k < 3; k++) {
      h[k] = middle[k] - extent * (0.2 + next());
      h[3 + k] = middle[k] + extent * (0.2 + next());
      h[18 + k] = -0.1 + 0.3 * next();
      h[21 + k] = 0.6 + 0.5 * next();
    }
    [h[6], h[7]] = [span[0] - 0.2, span[1] + 0.1];
    [h[8], h[9]] = [span[0] - 10, span[1] + 10];
    [h[10], h[11]] = [Math.log(scale * 0.4), Math.log(scale * 2.5)];
    [h[12], h[13]] = [0.6 * next(), 1.4 * next()];
    [h[14], h[15], h[16], h[17]] = [-2, 0.5, -3, -0.5].map((v) => v + 0.2 * next());
    for (let k = 0; k < 24; k++) data.writeFloatLE(h[k], b * 96 + 4 * k);
    for (let i = 256 * b; i < Math.min(n, 256 * b + 256); i++) truth.push(gaussian(i, h));
  }
  return { data, truth };

  function gaussian(i, h) {
    const xyz = [code(16), code(16), code(16)],
      life = code(16),
      sizes = [code(8), code(8), code(8)];
    const opacity = 30 + Math.floor(next() * 226),
      largest = code(2);
    const small = [0, 0, 0].map(() => Math.floor(next() * 1000) + 10),
      shift = [0, 0, 0].map(() => Math.floor(next() * 1023));
    const turn = [0, 0, 0].map(() => Math.floor(next() * 1023)),
      rgb = [code(8), code(8), code(8)];
    // A third has an infinite lifespan, a few have no flat part at all.
    const die = next(),
      wide = die < 0.33 ? 255 : die < 0.4 ? 0 : 1 + Math.floor(next() * 254),
      soft = code(8);
    const label = entries ? Math.floor(next() * entries) : 0;
    // The three others must leave something for the largest.
    const others = small.map((c) => (c - 511) / 511 / Math.sqrt(2));
    while (others.reduce((s, v) => s + v * v, 0) > 0.74)
      others.forEach(
        (v, k) => ((small[k] = Math.round((small[k] + 511) / 2)), (others[k] = (small[k] - 511) / 511 / Math.sqrt(2))),
      );
    const words = [
      xyz[0] | (xyz[1] << 16),
      xyz[2] | (life << 16),
      sizes[0] | (sizes[1] << 8) | (sizes[2] << 16) | (opacity << 24),
      (largest << 30) | (small[0] << 20) | (small[1] << 10) | small[2],
      shift[0] | (shift[1] << 10) | (shift[2] << 20),
      turn[0] | (turn[1] << 10) | (turn[2] << 20),
      rgb[0] | (rgb[1] << 8) | (rgb[2] << 16) | (wide << 24),
      label | (soft << 16),
    ];
    const start = Math.ceil(n / 256) * 96;
    words.forEach((word, w) => {
      for (let byte = 0; byte < 4; byte++) data[start + (4 * w + byte) * n + i] = (word >>> (8 * byte)) & 255;
    });
    const half = wide === 255 ? Infinity : wide === 0 ? 0 : Math.exp(lerp(h[14], h[15], (wide - 1) / 253));
    const softness = Math.exp(lerp(h[16], h[17], soft / 255)),
      length = span[1] - span[0];
    const reach = wide === 255 ? length / 2 : Math.min(half + 3 * softness, length);
    const quat = [...others];
    quat.splice(largest, 0, Math.sqrt(1 - others.reduce((s, v) => s + v * v, 0)));
    return {
      mean: xyz.map((c, k) => lerp(h[k], h[3 + k], c / 65535)),
      center: lerp(h[6], h[7], life / 65535),
      velocity: shift.map((c) => (h[12] * (c - 511)) / 511 / reach),
      spin: turn.map((c) => (h[13] * (c - 511)) / 511 / reach),
      scale: sizes.map((c) => Math.exp(lerp(h[10], h[11], c / 255))),
      quat,
      opacity: opacity / 255,
      half,
      soft: softness,
      color: rgb.map((c, k) => lerp(h[18 + k], h[21 + k], c / 255)),
      label,
      span,
    };
  }
}

/// A palette: {data, values: [entry][k − 1][channel]}.
function palette(next, degree, entries) {
  const per = (degree + 1) ** 2 - 1,
    data = Buffer.alloc(12 + 3 * per * entries),
    ranges = new Float32Array([0.4, 0.25, 0.15]);
  ranges.forEach((r, k) => data.writeFloatLE(r, 4 * k));
  for (let i = 12; i < data.length; i++) data[i] = 1 + Math.floor(next() * 255);
  const values = Array.from({ length: entries }, (_, e) =>
    Array.from({ length: per }, (_, k) =>
      [0, 1, 2].map(
        (c) => (ranges[Math.floor(Math.sqrt(k + 1)) - 1] * (data[12 + (3 * k + c) * entries + e] - 128)) / 127,
      ),
    ),
  );
  return { data, values };
}

/// Key masks of `n` Gaussians at `keys` seconds: {data: decoded bytes, seen: [key][Gaussian]}. Some blocks are hidden
/// as a whole, as those of a writer that puts alike lives together.
export function keyMasks(next, n, keys) {
  const packed = Math.ceil(n / 8),
    data = Buffer.alloc(8 + keys.length * (8 + packed));
  data.writeUInt32LE(keys.length, 0);
  keys.forEach((t, k) => data.writeDoubleLE(t, 8 + 8 * k));
  const seen = keys.map(() => {
    const hidden = Array.from({ length: Math.ceil(n / 256) }, () => next() < 0.3);
    return Array.from({ length: n }, (_, i) => next() < 0.4 && !hidden[i >> 8]);
  });
  seen.forEach((row, k) =>
    row.forEach((bit, i) => {
      // A row is stored as the difference to the one before.
      if (bit !== (k ? seen[k - 1][i] : false)) data[8 + 8 * keys.length + k * packed + (i >> 3)] |= 1 << (i & 7);
    }),
  );
  // Bits beyond the last Gaussian mean nothing.
  keys.forEach((_, k) => n % 8 && (data[8 + 8 * keys.length + (k + 1) * packed - 1] |= 0x100 - (1 << (n % 8))));
  return { data, seen };
}

/// Whether key masks {keys, seen} admit Gaussian `i` at `t`.
export function admits({ keys, seen }, i, t) {
  const before = keys.filter((k) => k <= t).length - 1,
    after = keys.findIndex((k) => k >= t);
  const [l, r] = [Math.max(before, 0), after < 0 ? keys.length - 1 : after];
  return seen[l][i] || seen[r][i];
}

/// Lays out a file. `sections`: [{kind, data, codec, level, count, words, from, to, palette, page, flags, patch}] in
/// their order.
export function layout(json, sections, { major = 1, minor = 0 } = {}) {
  let text = Buffer.from(JSON.stringify(json));
  text = Buffer.concat([text, Buffer.alloc((4 - (text.length % 4)) % 4, 32)]);
  const index = Buffer.alloc(8 + text.length + 64 * sections.length);
  index.writeUInt32LE(text.length, 0);
  text.copy(index, 4);
  index.writeUInt32LE(sections.length, 4 + text.length);
  let at = 64 + index.length;
  const bodies = sections.map((s) => (s.codec ? deflateRawSync(s.data, { level: 9 }) : s.data));
  sections.forEach((s, i) => {
    const e = index.subarray(8 + text.length + 64 * i);
    e.write(s.kind, 0, 'latin1');
    e.writeUInt32LE(s.flags ?? 0, 4);
    e.writeBigUInt64LE(BigInt(at), 8);
    e.writeUInt32LE(bodies[i].length, 16);
    e.writeUInt32LE(s.data.length, 20);
    e.writeUInt32LE(crc(bodies[i]), 24);
    e.writeUInt16LE(s.codec ?? 0, 28);
    e.writeUInt16LE(s.level ?? 0, 30);
    e.writeUInt32LE(s.count ?? 0, 32);
    e.writeUInt32LE(s.words ?? 0, 36);
    e.writeDoubleLE(s.from ?? 0, 40);
    e.writeDoubleLE(s.to ?? 0, 48);
    e.writeUInt32LE(s.kind === 'PAGE' ? (s.palette ?? 0xffffffff) : (s.page ?? 0), 56);
    s.patch?.(e);
    at += bodies[i].length;
  });
  const head = Buffer.alloc(64);
  Buffer.from([0x89, 0x53, 0x34, 0x44, 13, 10, 26, 10]).copy(head);
  head.writeUInt16LE(major, 8);
  head.writeUInt16LE(minor, 10);
  head.writeUInt32LE(index.length, 12);
  head.writeBigUInt64LE(BigInt(at), 16);
  head.writeUInt32LE(crc(index), 24);
  head.writeUInt32LE(crc(head.subarray(0, 60)), 60);
  return Buffer.concat([head, index, ...bodies]);
}

/// A finished file as one that grows: its index behind its sections, or where `at` states.
export function grown(bytes, { at } = {}) {
  const size = bytes.readUInt32LE(12),
    out = Buffer.concat([bytes, bytes.subarray(64, 64 + size)]);
  out.writeUInt16LE(2, 8);
  out.writeUInt16LE(0, 10);
  out.writeBigUInt64LE(BigInt(out.length), 16);
  out.writeBigUInt64LE(at ?? BigInt(bytes.length), 28);
  out.writeUInt32LE(crc(out.subarray(0, 60)), 60);
  return out;
}

/// A 1x1 PNG.
const POSTER = Buffer.from(
  'iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg==',
  'base64',
);

/// The sample: {bytes, json, sections, truth: Gaussians with `span`, `sh` and `admitted(t)`}. `scale` multiplies all
/// counts, `codec`: of every section (default: some packed, some raw). `masks`: seconds between key times, 0: no masks.
/// `without`: a second; no masks are written, but whom they hide then has no opacity.
export function sample({
  seed = 7,
  scale = 1,
  codec,
  size = 0.05,
  masks = 0,
  without,
  patch = (s) => s,
  json: more = {},
} = {}) {
  const next = random(seed),
    fps = 30,
    clip = [2, 6],
    end = clip[1] + 1 / fps;
  const palettes = [palette(next, 3, 64), palette(next, 1, 5)];
  const sections = palettes.map((p, i) => ({
    kind: 'PALT',
    data: p.data,
    codec: codec ?? i,
    level: [3, 1][i],
    count: [64, 5][i],
  }));
  sections.push({ kind: 'POST', data: POSTER, codec: 0 }, { kind: 'NOTE', data: Buffer.from('skip me'), codec: 7 });
  const truth = [];
  const add = (n, from, to, tier, which) => {
    const count = Math.max(1, Math.round(n * scale));
    const made = page(next, count, [from, to], {
      entries: palettes[which]?.values.length ?? 0,
      scale: size,
      center: [0, 0, 4],
      extent: 0.9,
    });
    // From random numbers of their own, so that the Gaussians are the same with and without masks. A page of one
    // Gaussian has one key time only.
    const number = masks && count > 1 ? Math.ceil((to - from) / masks) : 1,
      keys = Array.from({ length: number }, (_, k) => from + k * masks);
    const own = masks && tier === 0 ? keyMasks(random(seed + truth.length), count, keys) : null;
    const admitted = (i, t) => !own || admits({ keys, seen: own.seen }, i, t);
    made.truth.forEach((g, i) => {
      truth.push({ ...g, sh: palettes[which]?.values[g.label] ?? [], admitted: (t) => admitted(i, t) });
      // Plane 11 is the highest byte of word 2.
      const opacity = Math.ceil(count / 256) * 96 + 11 * count + i;
      if (without !== undefined && !admitted(i, without)) made.data[opacity] = 0;
    });
    const place = sections.length;
    sections.push({
      kind: 'PAGE',
      data: made.data,
      codec: codec ?? sections.length & 1,
      level: tier,
      count,
      words: 8,
      from,
      to,
      palette: which < 0 ? undefined : which,
    });
    if (own && without === undefined) {
      const shape = { count, from: keys[0], to: keys.at(-1), page: place };
      sections.push({ kind: 'MASK', data: own.data, codec: codec ?? (place >> 1) & 1, ...shape });
    }
  };
  add(700, clip[0], end, 0, 0);
  add(1025, clip[0], end, 1, 0);
  for (let i = 0; i < 4; i++)
    add([300, 256, 511, 1][i], clip[0] + i, i === 3 ? end : clip[0] + i + 1, 0, [1, -1, 0, 1][i]);
  const json = {
    clip,
    fps,
    up: [0, -1, 0],
    background: [0.1, 0.2, 0.3],
    sh_degree: 3,
    gaussians: truth.length,
    title: 'Sample',
    unit: null,
    view: { position: [0, 0, 0], target: [0, 0, 4], up: [0, -1, 0], fov_y: 45 },
    cameras: [
      {
        name: 'front',
        world_from_camera: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0],
        width: 160,
        height: 120,
        fx: 150,
        fy: 150,
        cx: 80,
        cy: 60,
      },
    ],
    ...more,
  };
  const ready = patch(sections) ?? sections;
  return { bytes: layout(json, ready), json, sections: ready, truth };
}

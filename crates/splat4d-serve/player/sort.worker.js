// Which Gaussians are drawn at a time, and in which order: a counting sort by depth, far first. `path` is the motion of
// docs/format.md; motion.js builds on it.
//
// A classic script that is also a module, like decode.worker.js; a page finds it in `globalThis.splat4dSort`.
'use strict';

/// Gaussians a block header describes, its f32 numbers, words a Gaussian (docs/format.md).
const BLOCK = 256,
  HEADER = 24,
  WORDS = 8;
/// Gaussians a row of the backend's texture: 2048 texels, two each.
const ROW = 1024;
/// Numbers kept of a Gaussian: position at the page's first second, velocity, first and last second it can be seen.
const TRACK = 8;
/// Keys of the counting sort: 16 bits.
const KEYS = 65536;
/// A window of visibility is widened by this, s: rounding must lose no Gaussian, the shader decides exactly.
const SLACK = 1e-5;
/// Opacity below which nothing is drawn (Kerbl et al. 2023).
const ALPHA_MIN = 1 / 255;

/// Standard deviations within which a Gaussian can be seen: an opaque one reaches 1/255 at 3.3.
const FOOTPRINT = 3.3;

/// Softnesses that belong to the reach of a Gaussian that dies (docs/format.md).
const REACH_TAILS = 3;

/// 10 bits as a share of a largest number.
const signed10 = (word, bit) => (((word >>> bit) & 1023) - 511) / 511;
const lerp = (a, b, u) => a + (b - a) * u;

/// Motion and lifespan of Gaussian `i` of a page whose span is `span` long, into `out`: mean at the lifespan's centre
/// (3), that centre, velocity (3), half-width, softness, opacity, reach.
function path(words, headers, i, span, out) {
  const w = WORDS * i,
    f = HEADER * Math.floor(i / BLOCK),
    h = headers;
  out[0] = lerp(h[f], h[f + 3], (words[w] & 0xffff) / 65535);
  out[1] = lerp(h[f + 1], h[f + 4], (words[w] >>> 16) / 65535);
  out[2] = lerp(h[f + 2], h[f + 5], (words[w + 1] & 0xffff) / 65535);
  out[3] = lerp(h[f + 6], h[f + 7], (words[w + 1] >>> 16) / 65535);
  const wide = words[w + 6] >>> 24;
  const half = wide === 255 ? Infinity : wide === 0 ? 0 : Math.exp(lerp(h[f + 14], h[f + 15], (wide - 1) / 253));
  const soft = Math.exp(lerp(h[f + 16], h[f + 17], ((words[w + 7] >>> 16) & 255) / 255));
  const reach = wide === 255 ? span / 2 : Math.min(half + REACH_TAILS * soft, span);
  const speed = h[f + 12] / reach;
  for (let k = 0; k < 3; k++) out[4 + k] = signed10(words[w + 4], 10 * k) * speed;
  out[7] = half;
  out[8] = soft;
  out[9] = (words[w + 2] >>> 24) / 255;
  out[10] = reach;
}

/// The largest standard deviation of Gaussian `i`.
function largest(words, headers, i) {
  const word = words[WORDS * i + 2],
    f = HEADER * Math.floor(i / BLOCK);
  const code = Math.max(word & 255, (word >>> 8) & 255, (word >>> 16) & 255);
  return Math.exp(lerp(headers[f + 10], headers[f + 11], code / 255));
}

/// The numbers of the key times around `t`, of rising `keys`: [last ≤ t, first ≥ t]; outside of all, the nearest twice.
function keysAround(keys, t) {
  let low = 0,
    high = keys.length;
  while (low < high) {
    const mid = (low + high) >> 1;
    if (keys[mid] < t) low = mid + 1;
    else high = mid;
  }
  if (low === keys.length) return [low - 1, low - 1];
  return [keys[low] === t ? low : Math.max(low - 1, 0), low];
}

/// Key masks of a page at a time: a Gaussian is drawn if its bit is set at one of the two key times around it
/// (docs/format.md). `at` is cheap as long as time stays between the same two.
class KeyMask {
  /// Bit i % 32 of word ⌊i / 32⌋: whether Gaussian i is drawn at the time of the last `at`; and how many are.
  bits;
  count = 0;
  #mask;
  #around = [-1, -1];

  /// `mask`: of SceneFile.mask, whose arrays are kept.
  constructor(mask) {
    this.#mask = mask;
    this.bits = new Uint32Array(mask.stride);
  }

  /// The numbers of the key times around `t`.
  around(t) {
    return keysAround(this.#mask.keys, t);
  }

  /// Second of key time `k`.
  key(k) {
    return this.#mask.keys[k];
  }

  /// Takes up the bits of time `t`; states whether they are others now.
  at(t) {
    const { rows, stride } = this.#mask,
      [l, r] = this.around(t);
    if (l === this.#around[0] && r === this.#around[1]) return false;
    this.#around = [l, r];
    this.count = 0;
    for (let w = 0; w < stride; w++) {
      const word = rows[l * stride + w] | rows[r * stride + w];
      this.bits[w] = word;
      this.count += ones(word);
    }
    return true;
  }
}

/// Bits that are set in a word: sums of 2, 4, 8 bits side by side, then all four bytes at once.
function ones(word) {
  word -= (word >>> 1) & 0x55555555;
  word = (word & 0x33333333) + ((word >>> 2) & 0x33333333);
  return Math.imul((word + (word >>> 4)) & 0x0f0f0f0f, 0x01010101) >>> 24;
}

/// What a view (camera from world, 3x4) sorts by: `depth` [a, b, c, d] of z = a·x + b·y + c·z + d, and its `center`.
function sight(m) {
  const center = [0, 1, 2].map((k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11]));
  return { depth: [m[8], m[9], m[10], m[11]], center };
}

/// Holds what sorting needs of each resident page.
class Sorter {
  #pages = [];
  #depths = new Float32Array(0);
  #bits = new Int32Array(0);
  #ids = new Uint32Array(0);
  #keys = new Uint16Array(0);
  #starts = new Uint32Array(KEYS);
  #range = new Float32Array(2);

  /// `page`: {id, row: its first row in the texture, count, words, headers, from, to}.
  add({ id, row, count, words, headers, from, to, tier = 0 }) {
    const track = new Float32Array(TRACK * count),
      p = new Float64Array(11);
    const blocks = new Float64Array(2 * Math.ceil(count / BLOCK)),
      sizes = new Float32Array(count);
    for (let i = 0; i < count; i++) {
      path(words, headers, i, to - from, p);
      const o = TRACK * i,
        c = p[3] - from;
      for (let k = 0; k < 3; k++) {
        track[o + k] = p[k] - p[4 + k] * c;
        track[o + 3 + k] = p[4 + k];
      }
      sizes[i] = largest(words, headers, i);
      // σ falls to where o·σ = 1/255 at this distance outside the half-width.
      const tail = p[9] < ALPHA_MIN ? NaN : p[8] * Math.sqrt(2 * Math.log(p[9] / ALPHA_MIN));
      track[o + 6] = p[9] < ALPHA_MIN ? Infinity : p[7] === Infinity ? -Infinity : c - p[7] - tail - SLACK;
      track[o + 7] = p[9] < ALPHA_MIN ? -Infinity : p[7] === Infinity ? Infinity : c + p[7] + tail + SLACK;
      const b = i >> 8;
      if (i % BLOCK === 0) ((blocks[2 * b] = Infinity), (blocks[2 * b + 1] = -Infinity));
      blocks[2 * b] = Math.min(blocks[2 * b], track[o + 6]);
      blocks[2 * b + 1] = Math.max(blocks[2 * b + 1], track[o + 7]);
    }
    this.#pages.push({ id, row, count, from, to, tier, track, blocks, sizes, mask: null });
    // The order of equal depths is that of numbers, whenever a page arrived.
    this.#pages.sort((a, b) => a.id - b.id);
  }

  drop(id) {
    this.#pages = this.#pages.filter((p) => p.id !== id);
  }

  /// Gives page `id` its key masks.
  mask(id, mask) {
    const page = this.#pages.find((p) => p.id === id);
    if (page) page.mask = new KeyMask(mask);
  }

  /// `order` if it is large enough, else a new one: whole rows of ROW numbers.
  room(order) {
    const rows = Math.ceil(this.total / ROW);
    return order?.length >= rows * ROW ? order : new Uint32Array(rows * ROW);
  }

  /// Gaussians of all pages.
  get total() {
    return this.#pages.reduce((n, p) => n + p.count, 0);
  }

  /// The orders of `views` (camera from world, 3x4) at `time`, in the arrays `spare` where they are large enough:
  /// {orders: [{order, count}], active, left}.
  orders({ time, views, near, fovea }, spare = []) {
    let active = 0,
      left = 0;
    const orders = views.map((m, k) => {
      const order = this.room(spare[k]),
        sorted = this.sort({ time, ...sight(m), near, fovea }, order);
      active = sorted.active;
      left = Math.max(left, sorted.left);
      return { order, count: sorted.count };
    });
    return { orders, active, left };
  }

  /// Writes the visible Gaussians (row·1024 + column) at `time` into `out`, the farthest first, by the camera's depth
  /// z = a·x + b·y + c·z + d for `depth` [a, b, c, d]. `fovea` (fovea.js) leaves out those of higher tiers away from the
  /// axis of a camera at `center`. Returns {count, active: Gaussians of this time's pages that their key masks admit, left: those
  /// that the fovea leaves out}.
  sort({ time, depth: [a, b, c, d], center = [0, 0, 0], near, fovea = null }, out) {
    const total = this.total;
    if (this.#depths.length < total) {
      this.#depths = new Float32Array(total);
      this.#bits = new Int32Array(this.#depths.buffer);
      this.#ids = new Uint32Array(total);
      this.#keys = new Uint16Array(total);
    }
    const depths = this.#depths,
      bits = this.#bits,
      ids = this.#ids,
      keys = this.#keys,
      starts = this.#starts;
    const [ex, ey, ez] = center;
    let n = 0,
      active = 0,
      left = 0,
      low = Infinity,
      high = 0;
    for (const { row, count, from, to, tier, track, blocks, sizes, mask } of this.#pages) {
      if (!(from <= time && time < to)) continue;
      mask?.at(time);
      active += mask?.count ?? count;
      const admitted = mask?.bits ?? null,
        edge = fovea !== null && tier >= fovea.tier;
      const t = time - from;
      for (let block = 0, first = 0; first < count; block++, first += BLOCK) {
        if (!(t >= blocks[2 * block] && t <= blocks[2 * block + 1])) continue;
        const end = Math.min(first + BLOCK, count);
        for (let i = first, o = TRACK * first; i < end; i++, o += TRACK) {
          if (t < track[o + 6] || t > track[o + 7]) continue;
          if (admitted !== null && !((admitted[i >> 5] >>> (i & 31)) & 1)) continue;
          const x = track[o] + track[o + 3] * t,
            y = track[o + 1] + track[o + 4] * t,
            w = track[o + 2] + track[o + 5] * t,
            z = a * x + b * y + c * w + d;
          // Phrased so that a NaN is left out too.
          if (!(z > near && z < Infinity)) continue;
          if (edge) {
            // The square of its distance from the camera's axis; a footprint that reaches the middle stays.
            const off = (x - ex) ** 2 + (y - ey) ** 2 + (w - ez) ** 2 - z * z;
            if (Math.sqrt(Math.max(off, 0)) - fovea.inner * z > FOOTPRINT * sizes[i]) {
              left++;
              continue;
            }
          }
          depths[n] = z;
          ids[n++] = row * ROW + i;
          if (z < low) low = z;
          if (z > high) high = z;
        }
      }
    }
    if (!n) return { count: 0, active, left };
    // The bits of positive floats grow like their logarithm, bent a little: near and far get alike fine steps.
    this.#range[0] = low;
    this.#range[1] = high;
    const edge = new Int32Array(this.#range.buffer);
    const least = edge[0],
      scale = edge[1] > least ? (KEYS - 1) / (edge[1] - least) : 0;
    starts.fill(0);
    for (let i = 0; i < n; i++) {
      const key = KEYS - 1 - (((bits[i] - least) * scale) | 0);
      keys[i] = key;
      starts[key]++;
    }
    for (let key = 0, sum = 0; key < KEYS; key++) {
      const here = starts[key];
      starts[key] = sum;
      sum += here;
    }
    // Equal depths are ordered by number front to back, so reversed back to front.
    for (let i = n - 1; i >= 0; i--) out[starts[keys[i]]++] = ids[i];
    return { count: n, active, left };
  }
}

globalThis.splat4dSort = { ALPHA_MIN, KeyMask, ROW, Sorter, lerp, path, signed10 };

if (typeof WorkerGlobalScope !== 'undefined' && self instanceof WorkerGlobalScope) {
  const sorter = new Sorter();
  self.onmessage = ({ data }) => {
    if (data.add) return sorter.add(data.add);
    if (data.drop !== undefined) return sorter.drop(data.drop);
    if (data.mask) return sorter.mask(data.page, data.mask);
    const begin = performance.now();
    const { orders, active, left } = sorter.orders(data.sort, data.spare);
    const ms = performance.now() - begin;
    self.postMessage({ orders, active, left, ms, generation: data.generation }, orders.map((o) => o.order.buffer));
  };
  self.postMessage({ ready: true });
}

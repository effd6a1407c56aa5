// The Gaussians of a playback file at any time as arrays, for engines that render them by themselves: Spark,
// PlayCanvas, Babylon.js, or yours. It streams like the player, and evaluates motion and spherical harmonics on the
// CPU.
//
//   const frames = new Frames('scene.s4d');
//   await frames.load(0.5);
//   const g = frames.at(0.5, [0, 0, -4]);   // g.count, g.position, g.rotation, g.scale, g.opacity, g.color

import { NEAR } from './player/camera.js';
import { SH, SPEED_RANGE, STEP_MAX } from './player/constants.js';
import { cutShort } from './player/errors.js';
import { Ladder, rungOf } from './player/ladder.js';
import { advance } from './player/schedule.js';
import { SceneFile } from './player/scene-file.js';
import { Stream } from './player/stream.js';
import './player/sort.worker.js';

const { ALPHA_MIN, KeyMask, lerp, path, signed10 } = globalThis.splat4dSort;

/// Gaussians a block header describes, its f32 numbers, words a Gaussian (docs/format.md).
const BLOCK = 256,
  HEADER = 24,
  WORDS = 8;
/// Numbers kept of a Gaussian: mean 3, velocity 3, rotation wxyz 4, its rate 4, scale 3, opacity, colour 3, half-width,
/// softness, centre; the last three of a page's clock, s.
const MEAN = 0,
  VELOCITY = 3,
  ROTATION = 6,
  RATE = 10,
  SCALE = 14,
  OPACITY = 17,
  COLOR = 18,
  HALF = 21,
  SOFT = 22,
  CENTER = 23,
  RECORD = 24;
/// Basis functions above degree 0 at a unit direction, into `out`, as many as `per`.
function basis(x, y, z, per, out) {
  const xx = x * x,
    yy = y * y,
    zz = z * z;
  out[0] = -SH.first * y;
  out[1] = SH.first * z;
  out[2] = -SH.first * x;
  if (per < 8) return;
  out[3] = SH.product * x * y;
  out[4] = -SH.product * y * z;
  out[5] = SH.axial * (2 * zz - xx - yy);
  out[6] = -SH.product * x * z;
  out[7] = SH.difference * (xx - yy);
  if (per < 15) return;
  out[8] = -SH.third * y * (3 * xx - yy);
  out[9] = SH.triple * x * y * z;
  out[10] = -SH.side * y * (4 * zz - xx - yy);
  out[11] = SH.pole * z * (2 * zz - 3 * xx - 3 * yy);
  out[12] = -SH.side * x * (4 * zz - xx - yy);
  out[13] = SH.cone * z * (xx - yy);
  out[14] = -SH.third * x * (xx - 3 * yy);
}

/// A page's Gaussians as numbers.
function records({ count, words, headers }, { from, to }) {
  const out = new Float32Array(RECORD * count),
    entries = new Uint16Array(count),
    p = new Float64Array(11),
    q = new Float64Array(4);
  for (let i = 0; i < count; i++) {
    const o = RECORD * i,
      w = WORDS * i,
      h = HEADER * Math.floor(i / BLOCK);
    path(words, headers, i, to - from, p);
    for (let k = 0; k < 3; k++) {
      out[o + MEAN + k] = p[k];
      out[o + VELOCITY + k] = p[4 + k];
      out[o + SCALE + k] = Math.exp(lerp(headers[h + 10], headers[h + 11], ((words[w + 2] >>> (8 * k)) & 255) / 255));
      out[o + COLOR + k] = lerp(headers[h + 18 + k], headers[h + 21 + k], ((words[w + 6] >>> (8 * k)) & 255) / 255);
    }
    const largest = words[w + 3] >>> 30;
    let rest = 1;
    for (let k = 0, bit = 20; k < 4; k++) {
      if (k === largest) continue;
      q[k] = signed10(words[w + 3], bit) * Math.SQRT1_2;
      rest -= q[k] * q[k];
      bit -= 10;
    }
    q[largest] = Math.sqrt(Math.max(rest, 0));
    const length = Math.hypot(...q),
      turn = headers[h + 13] / p[10];
    for (let k = 0; k < 4; k++) q[k] /= length;
    const [a, b, c] = [0, 10, 20].map((bit) => 0.5 * signed10(words[w + 5], bit) * turn);
    out.set(q, o + ROTATION);
    // ½(0, ω)⊗q
    out[o + RATE] = -a * q[1] - b * q[2] - c * q[3];
    out[o + RATE + 1] = a * q[0] + b * q[3] - c * q[2];
    out[o + RATE + 2] = b * q[0] + c * q[1] - a * q[3];
    out[o + RATE + 3] = c * q[0] + a * q[2] - b * q[1];
    out[o + OPACITY] = p[9];
    out[o + HALF] = p[7];
    out[o + SOFT] = p[8];
    out[o + CENTER] = p[3] - from;
    entries[i] = words[w + 7] & 0xffff;
  }
  return { out, entries };
}

/// What a `Stream` fills: decoded pages by id.
class Pages {
  all = new Map();
  #palettes = new Map();

  addPalette({ id, degree, count, ranges, bytes }) {
    const per = (degree + 1) ** 2 - 1,
      values = new Float32Array(3 * per * count);
    for (let k = 0; k < per; k++) {
      const range = ranges[k < 3 ? 0 : k < 8 ? 1 : 2];
      for (let c = 0; c < 3; c++) {
        const plane = (3 * k + c) * count;
        for (let i = 0; i < count; i++) values[3 * (per * i + k) + c] = (range * (bytes[plane + i] - 128)) / 127;
      }
    }
    this.#palettes.set(id, { per, values });
  }

  addPage(page, entry) {
    const { out, entries } = records(page, entry),
      { from, to, palette } = entry;
    this.all.set(page.id, { from, to, out, entries, count: page.count, palette: this.#palettes.get(palette), mask: null });
  }

  addMask(id, mask) {
    const page = this.all.get(id);
    if (page) page.mask = new KeyMask(mask);
  }

  dropPage(id) {
    this.all.delete(id);
  }
}

/// Most Gaussians that the file has at one time.
function most(pages) {
  const edges = pages.flatMap(({ from, to, count }) => [[from, count], [to, -count]]);
  // Where one span ends and another begins, only one of them is rendered.
  edges.sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  let now = 0,
    high = 0;
  for (const [, count] of edges) high = Math.max(high, (now += count));
  return high;
}

export class Frames {
  /// The file's metadata, once `ready` is.
  meta = null;
  /// A promise: the index is read. Rejects where there is no such file, or it is damaged.
  ready;
  /// Most Gaussians at any time, once `ready` is: the length of the arrays.
  capacity = 0;
  /// Whether it begins again at the end; played once, it stops at the last frame.
  loop = true;
  /// The clock, s of the scene. Set it, or `play()` and call `tick()` each frame.
  time = NaN;
  #speed = 1;
  #playing = false;
  #now = NaN;
  #file = null;
  #stream = null;
  #pages = new Pages();
  #gone = false;
  #arrays = null;
  /// Why pages are missing, the newest reason.
  #failure = null;

  /// `source`: an address, File, Blob or ArrayBuffer. `onchange()` is called when pages arrived: what `at` returns
  /// changes then. `onerror(error)`: a page could not be read, for example of a truncated file. `budget`: bytes of
  /// pages that stay in memory. `rung`: 'auto', or the rung of a bitrate ladder that alone is loaded, from 1 on.
  constructor(source, { onchange = () => {}, onerror = () => {}, budget, rung = 'auto' } = {}) {
    this.ready = SceneFile.open(source).then((file) => {
      if (this.#gone) return file.close();
      this.#file = file;
      this.meta = file.meta;
      if (Number.isNaN(this.time)) this.time = file.meta.clip[0];
      this.capacity = most(file.pages);
      const failed = (error) => {
        this.#failure = error;
        onerror(error);
      };
      const ladder = Object.assign(new Ladder(file.meta.ladder), { pinned: rungOf(rung) });
      this.#stream = new Stream(file, this.#pages, { ...(budget ? { budget } : {}), ladder, onchange, onerror: failed });
      if (file.truncated) failed(cutShort(file, source));
      this.#stream.update(this.time);
      onchange();
    });
    this.ready.catch(() => {});
  }

  play() {
    if (this.#playing) return;
    const [first, last] = this.meta?.clip ?? [0, Infinity];
    if (!this.loop && this.time >= last) this.time = first;
    this.#playing = true;
    this.#now = NaN;
  }

  pause() {
    this.#playing = false;
  }

  get paused() {
    return !this.#playing;
  }

  /// Speed of `play()`, 0.1 to 4.
  get speed() {
    return this.#speed;
  }
  set speed(x) {
    this.#speed = Math.min(Math.max(+x || 1, SPEED_RANGE[0]), SPEED_RANGE[1]);
  }

  /// Seconds that the clip lasts; 0 until it is open.
  get duration() {
    return this.meta ? this.meta.clip[1] - this.meta.clip[0] : 0;
  }

  /// {rung, chosen, limit, rungs, reason, rate, leftOut} at `time` (docs/player.md); null without a bitrate ladder.
  get ladder() {
    return this.#stream?.rungs(this.time) ?? null;
  }

  /// Moves the clock: once per frame. A clock whose pages have not arrived waits.
  tick(now = performance.now()) {
    if (!this.#stream) return;
    const { clip, fps } = this.meta;
    if (this.#playing) {
      const step = Math.min((now - this.#now) / 1000 || 0, STEP_MAX);
      if (this.#stream.playable(this.time)) {
        const limits = { first: clip[0], last: clip[1], frameTime: 1 / (fps || 30), loop: this.loop };
        const { time, ended } = advance(this.time, step * this.#speed, limits);
        this.time = time;
        if (ended) this.#playing = false;
      }
    }
    this.#now = now;
    this.#stream.update(this.time, { playing: this.#playing, speed: this.#speed, loop: this.loop });
  }

  /// Sets the clock and resolves when the pages of that time are there. Rejects where one of them cannot be read.
  async load(time) {
    this.time = time;
    await this.ready;
    if (!this.#stream) return;
    await this.#stream.settled(time);
    if (this.#gone) return;
    const whole = this.#stream.ready(time, Infinity) === 1 && !this.#file.lacks(time);
    if (this.#failure && !whole) throw this.#failure;
  }

  /// The Gaussians that are visible at `time`, colours as seen from `eye` (null: base colours): {count, position 3,
  /// rotation 4 as x y z w, scale 3, opacity 1, color 3 per Gaussian}, in the file's axes. `forward`: the camera's unit
  /// direction; what is nearer than the capture's cameras could see is left out then, as the player does. Colours are
  /// display values, at least 0. The arrays have room for `capacity` Gaussians and are those of the next call too.
  at(time, eye = null, forward = null) {
    const { capacity } = this;
    this.#arrays ??= {
      // Rows that were never written are Gaussians too: an engine may compute with them.
      count: 0, position: new Float32Array(3 * capacity), rotation: new Float32Array(4 * capacity).fill(0.5),
      scale: new Float32Array(3 * capacity).fill(1), opacity: new Float32Array(capacity), color: new Float32Array(3 * capacity),
    };
    const to = this.#arrays;
    to.count = 0;
    if (!this.#file || this.#gone) return to;
    const t = this.#file.clamp(time),
      near = this.meta.near ?? NEAR;
    // In the order of the file, whenever pages arrived.
    const ids = [...this.#pages.all.keys()].sort((a, b) => a - b);
    for (const id of ids) {
      const page = this.#pages.all.get(id);
      if (page.from <= t && t < page.to) write(page, t, { eye, forward, near }, to);
    }
    return to;
  }

  dispose() {
    this.#gone = true;
    this.#stream?.destroy();
    this.#file?.close();
    this.#pages.all.clear();
  }
}

const Y = new Float64Array(15);

/// Appends a page's Gaussians.
function write(page, t, { eye, forward, near }, to) {
  const { out, entries, count, palette, mask } = page,
    per = eye && palette ? palette.per : 0;
  mask?.at(t);
  const admitted = mask?.bits ?? null,
    clock = t - page.from;
  let n = to.count;
  for (let i = 0, o = 0; i < count; i++, o += RECORD) {
    if (admitted && !((admitted[i >> 5] >>> (i & 31)) & 1)) continue;
    const d = clock - out[o + CENTER],
      late = (Math.abs(d) - out[o + HALF]) / out[o + SOFT];
    const opacity = late > 0 ? out[o + OPACITY] * Math.exp(-0.5 * late * late) : out[o + OPACITY];
    // Half a step of 32 bits: an opacity of exactly 1/255 is rendered.
    if (opacity < ALPHA_MIN * (1 - 1e-7)) continue;
    const x = out[o] + d * out[o + VELOCITY],
      y = out[o + 1] + d * out[o + VELOCITY + 1],
      z = out[o + 2] + d * out[o + VELOCITY + 2];
    const qw = out[o + ROTATION] + d * out[o + RATE],
      qx = out[o + ROTATION + 1] + d * out[o + RATE + 1],
      qy = out[o + ROTATION + 2] + d * out[o + RATE + 2],
      qz = out[o + ROTATION + 3] + d * out[o + RATE + 3];
    const length = Math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz);
    // Phrased so that a NaN is left out too.
    if (!(Math.abs(x + y + z) < Infinity && length > 0 && length < Infinity)) continue;
    if (forward && (x - eye[0]) * forward[0] + (y - eye[1]) * forward[1] + (z - eye[2]) * forward[2] <= near) continue;
    to.position[3 * n] = x;
    to.position[3 * n + 1] = y;
    to.position[3 * n + 2] = z;
    to.rotation[4 * n] = qx / length;
    to.rotation[4 * n + 1] = qy / length;
    to.rotation[4 * n + 2] = qz / length;
    to.rotation[4 * n + 3] = qw / length;
    for (let k = 0; k < 3; k++) to.scale[3 * n + k] = out[o + SCALE + k];
    to.opacity[n] = opacity;
    let [r, g, b] = [out[o + COLOR], out[o + COLOR + 1], out[o + COLOR + 2]];
    if (per) {
      const [dx, dy, dz] = [x - eye[0], y - eye[1], z - eye[2]],
        away = Math.sqrt(dx * dx + dy * dy + dz * dz) || 1;
      basis(dx / away, dy / away, dz / away, per, Y);
      for (let k = 0, at = 3 * per * entries[i]; k < per; k++, at += 3) {
        r += Y[k] * palette.values[at];
        g += Y[k] * palette.values[at + 1];
        b += Y[k] * palette.values[at + 2];
      }
    }
    to.color[3 * n] = Math.max(r, 0);
    to.color[3 * n + 1] = Math.max(g, 0);
    to.color[3 * n + 2] = Math.max(b, 0);
    n++;
  }
  to.count = n;
}

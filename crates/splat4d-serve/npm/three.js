// A moving scene of Gaussians as an object of three.js (WebGLRenderer): `scene.add(new Splat4D('knight.s4d'))`.
//
// Gaussians are drawn after opaque meshes, the farthest first, each tested against the depth that meshes left: at its
// centre, so that a mesh cuts through the scene between Gaussians. They write no depth. Colours are blended as they
// were learnt, in display values, which is what three.js writes to the canvas; into a linear render target they come
// out too bright.

import * as THREE from 'three';
import { NEAR } from './player/camera.js';
import { SPEED_RANGE, STEP_MAX } from './player/constants.js';
import { BATCH, CHANNELS, ORDER_WIDTH, SPLAT } from './player/glsl.js';
import { Ladder, rungOf } from './player/ladder.js';
import { Order } from './player/order.js';
import { Follower, Schedule, advance } from './player/schedule.js';
import { SceneFile } from './player/scene-file.js';
import { Sound } from './player/sound.js';
import { Stream } from './player/stream.js';
import { BLOCKS_WIDTH, J_MARGIN, WIDTH, blockTexels, corners, paletteTexels } from './player/texels.js';
import { Rows } from './player/gl.js';

const { ROW } = globalThis.splat4dSort;
/// Rows of the words' texture to begin with.
const FIRST_ROWS = 32;
const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };
/// A longer time between two frames is a page that rested, ms.
const PAUSED = 500;
/// Marks a clock that waits for pages: no other time can be rendered.
const HOLD = () => null;

// The image's rows run upwards here, so that `focal.y` is negative; `origin`: where the viewport begins.
const VERTEX =
  SPLAT.replace('#version 300 es\n', '') +
  `
uniform vec2 depth_row;
flat out vec4 shape;
flat out vec2 middle;
flat out vec3 tint;
void main() {
  int i = gl_InstanceID * ${BATCH} + (gl_VertexID >> 2), corner = gl_VertexID & 3;
  Splat s = splat(ivec2(i % ${ORDER_WIDTH}, i / ${ORDER_WIDTH}));
  shape = s.shape;
  middle = s.place.xy;
  tint = s.tint.rgb;
  vec2 axis = s.place.zw, side = vec2((corner & 1) * 2 - 1, (corner >> 1) * 2 - 1);
  vec2 at = middle + side.x * axis + side.y * s.tint.w * vec2(-axis.y, axis.x);
  gl_Position = vec4(at / size * 2.0 - 1.0, depth_row.y / s.depth - depth_row.x, 1);
  if (axis == vec2(0)) gl_Position = vec4(2, 2, 0, 1);
}`;

const FRAGMENT = `
precision highp float;
uniform vec2 origin;
flat in vec4 shape;
flat in vec2 middle;
flat in vec3 tint;
out vec4 color;
void main() {
  vec2 d = gl_FragCoord.xy - origin - middle;
  float alpha = shape.w * exp(-0.5 * (shape.x * d.x * d.x + shape.z * d.y * d.y) - shape.y * d.x * d.y);
  if (!(alpha >= 1.0 / 255.0)) discard;
  alpha = min(alpha, 0.99);
  color = vec4(clamp(tint, 0.0, 1.0) * alpha, alpha);
}`;

/// A texture whose texels are fetched, never filtered.
function texture(array, width, height, format, type, internal) {
  const made = new THREE.DataTexture(array, width, height, format, type);
  made.internalFormat = internal;
  made.needsUpdate = true;
  return made;
}
const words = (rows) =>
  texture(new Uint32Array(rows * WIDTH * 4), WIDTH, rows, THREE.RGBAIntegerFormat, THREE.UnsignedIntType, 'RGBA32UI');
const blocks = (rows) =>
  texture(new Float32Array(rows * BLOCKS_WIDTH * 4), BLOCKS_WIDTH, rows, THREE.RGBAFormat, THREE.FloatType, 'RGBA32F');
const palettes = (rows) =>
  texture(new Uint8Array(rows * WIDTH * 4), WIDTH, rows, THREE.RGBAIntegerFormat, THREE.UnsignedByteType, 'RGBA8UI');
const orders = (rows) =>
  texture(new Uint32Array(rows * ORDER_WIDTH), ORDER_WIDTH, rows, THREE.RedIntegerFormat, THREE.UnsignedIntType, 'R32UI');

export class Splat4D extends THREE.Mesh {
  isSplat4D = true;
  /// The file's metadata, once it is open.
  meta = null;
  /// A promise: the index is read and `meta` is there. Rejects where there is no such file, or it is damaged.
  ready;
  /// Whether it begins again at the end; played once, it stops at the last frame.
  loop = true;
  /// What is heard, with the option `sound`.
  sound = null;
  /// Takes what the file calls up, once it is open, to the object's `up`; multiply a pose of the file by it.
  objectFromFile = new THREE.Matrix4();
  #time = 0;
  #playing = false;
  #speed = 1;
  /// The frame of the renderer that the clock was last moved for, and when, ms.
  #frame = -1;
  #now = NaN;
  /// Jumps and stops of the clock: its own, and those of a page that sets `time`.
  #epoch = 0;
  #follower = new Follower();
  #schedule;
  /// The order that is rendered next: {order, count, generation}.
  #next = {};
  #file = null;
  #stream = null;
  #order;
  #rows = new Rows(FIRST_ROWS);
  #pages = new Map();
  #retired = [];
  #palettes = new Map();
  #paletteRows = 0;
  #gone = false;
  #drawn = 0;
  #onchange;
  #waiting = [];
  /// The choice of the rung, from `ready` on; and the one that alone is rendered.
  #ladder = new Ladder();
  #pin = null;
  /// When the last frame began, ms.
  #frameAt = NaN;
  /// Whether sound is to be loaded.
  #sounds;
  #scratch = { view: new THREE.Matrix4(), viewport: new THREE.Vector4(), rows: new Float64Array(12) };

  /// `source`: an address, File, Blob or ArrayBuffer. `onchange()` is called when a better image can be drawn: pages
  /// came,
  /// or a new order; pages that render on demand render then. `budget`: bytes of Gaussians that stay in memory. `up`:
  /// the object's axis ('x', 'y', 'z') that points up as the file's up does; null keeps the file's axes. `sound`: the
  /// file's sound plays with the clock. `rung`: 'auto', or the rung of a bitrate ladder that alone is rendered, from 1 on.
  constructor(source, { onchange = () => {}, budget, up = 'y', sound = false, rung = 'auto' } = {}) {
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setIndex(new THREE.BufferAttribute(corners(), 1));
    geometry.instanceCount = 0;
    const uniform = (value) => ({ value });
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: {
        words: uniform(words(FIRST_ROWS)), blocks: uniform(blocks(FIRST_ROWS)), palette: uniform(palettes(1)),
        order: uniform(orders(1)), rotation: uniform(new THREE.Matrix3()), translation: uniform(new THREE.Vector3()),
        eye: uniform(new THREE.Vector3()), focal: uniform(new THREE.Vector2()), center: uniform(new THREE.Vector2()),
        size: uniform(new THREE.Vector2()), low: uniform(new THREE.Vector2()), high: uniform(new THREE.Vector2()),
        depth_range: uniform(new THREE.Vector2(0, 1)), depth_row: uniform(new THREE.Vector2()), origin: uniform(new THREE.Vector2()),
        time: uniform(0), near: uniform(NEAR), flow_scale: uniform(1), channel: uniform(CHANNELS.color), count: uniform(0),
      },
      transparent: true,
      depthTest: true,
      depthWrite: false,
      side: THREE.DoubleSide,
      blending: THREE.CustomBlending,
      blendSrc: THREE.OneFactor,
      blendDst: THREE.OneMinusSrcAlphaFactor,
      blendSrcAlpha: THREE.OneFactor,
      blendDstAlpha: THREE.OneMinusSrcAlphaFactor,
    });
    super(geometry, material);
    // Its bounds depend on time, and all culling is the shader's.
    this.frustumCulled = false;
    this.#onchange = onchange;
    if (sound) this.sound = new Sound();
    this.#sounds = sound;
    this.#pin = rungOf(rung);
    this.#order = new Order(NEAR, (answer) => this.#ordered(answer));
    this.#schedule = new Schedule(this.#order);
    this.ready = SceneFile.open(source).then((file) => {
      if (this.#gone) return file.close();
      this.#file = file;
      this.meta = file.meta;
      this.#time ||= file.meta.clip[0];
      if (up) {
        const [from, to] = [file.meta.up, AXES[up]].map((axis) => new THREE.Vector3(...axis).normalize());
        this.objectFromFile.makeRotationFromQuaternion(new THREE.Quaternion().setFromUnitVectors(from, to));
      }
      this.#ladder = Object.assign(new Ladder(file.meta.ladder), { pinned: this.#pin });
      const options = { ...(budget ? { budget } : {}), ladder: this.#ladder, onchange: () => this.#onchange() };
      this.#stream = new Stream(file, this, options);
      this.#onchange();
    });
    this.ready.catch(() => {});
  }

  /// Where the clock is, s: `meta.clip[0]` to `meta.clip[1]`, outside it is clamped. Set it each frame, or `play()`.
  get time() {
    return this.#time;
  }
  set time(t) {
    this.#time = t;
    if (this.#playing) this.#epoch++;
  }

  /// The second that the newest image shows: a frame is rendered at the time that its order was computed for.
  get renderedTime() {
    return this.#schedule.shown?.time ?? this.#time;
  }

  /// Plays from now on, as often as it is rendered.
  play() {
    if (this.#playing) return;
    const [first, last] = this.meta?.clip ?? [0, Infinity];
    if (!this.loop && this.#time >= last) this.#time = first;
    this.#playing = true;
    this.#now = NaN;
    this.#epoch++;
  }

  /// Stops at the image that is shown.
  pause() {
    this.#anchor();
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
    this.#anchor();
    this.#speed = Math.min(Math.max(+x || 1, SPEED_RANGE[0]), SPEED_RANGE[1]);
  }

  /// The playing clock continues from what is shown: images that were requested ahead are not rendered.
  #anchor() {
    if (!this.#playing) return;
    const { shown } = this.#schedule;
    if (shown?.epoch === this.#epochs) this.#time = shown.time;
    this.#epoch++;
  }

  get #epochs() {
    return this.#epoch + this.#follower.epoch;
  }

  /// Seconds that it lasts; 0 until it is open.
  get duration() {
    return this.meta ? this.meta.clip[1] - this.meta.clip[0] : 0;
  }

  /// 'auto', or the rung of the file's bitrate ladder that alone is rendered, 1 the coarsest.
  get rung() {
    return this.#pin === null ? 'auto' : this.#pin + 1;
  }
  set rung(x) {
    this.#ladder.pinned = this.#pin = rungOf(x);
    this.#onchange();
  }

  /// {rung, chosen, limit, rungs, reason, rate, leftOut} of the newest image (docs/player.md); null without a ladder.
  get ladder() {
    return this.#stream?.rungs(this.renderedTime) ?? null;
  }

  /// Gaussians in the newest order.
  get drawn() {
    return this.#drawn;
  }

  /// Resolves when the pages of `time` are there and the next image shows it, seen as in the last one.
  async settled() {
    await this.ready;
    await this.#stream?.settled(this.#time);
    const [first, last] = this.meta.clip;
    while (!this.#gone) {
      this.#want(Math.min(Math.max(this.#time, first), last), null, performance.now());
      if (!this.#schedule.ask(performance.now())) return;
      await new Promise((done) => this.#waiting.push(done));
    }
  }

  dispose() {
    this.#gone = true;
    this.sound?.drop();
    this.#stream?.destroy();
    this.#file?.close();
    this.#order.destroy();
    for (const done of this.#waiting.splice(0)) done();
    for (const name of ['words', 'blocks', 'palette', 'order']) this.material.uniforms[name].value.dispose();
    this.material.dispose();
    this.geometry.dispose();
  }

  // three.js: called before every image, once an eye.

  onBeforeRender = (renderer, _scene, camera) => {
    if (!this.#stream) return;
    const { meta } = this,
      u = this.material.uniforms,
      now = performance.now();
    this.#tick(renderer.info.render.frame, now);
    // Camera axes x right, y down, z forward; the object may be turned, moved and scaled, alike in all directions.
    const view = this.#scratch.view.multiplyMatrices(camera.matrixWorldInverse, this.matrixWorld).multiply(this.objectFromFile),
      e = view.elements,
      m = this.#scratch.rows;
    for (let row = 0; row < 3; row++) for (let k = 0; k < 4; k++) m[4 * row + k] = (row ? -1 : 1) * e[4 * k + row];
    const shown = this.#follow(now);
    u.rotation.value.set(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]);
    u.translation.value.set(m[3], m[7], m[11]);
    u.eye.value.setFromMatrixPosition(view.invert());
    const p = camera.projectionMatrix.elements,
      { x, y, z: width, w: height } = renderer.getCurrentViewport(this.#scratch.viewport);
    const fx = (p[0] * width) / 2,
      fy = (p[5] * height) / 2,
      cx = ((1 - p[8]) * width) / 2,
      cy = ((1 - p[9]) * height) / 2;
    u.focal.value.set(fx, -fy);
    u.center.value.set(cx, cy);
    u.size.value.set(width, height);
    u.origin.value.set(x, y);
    const mx = (J_MARGIN * 0.5 * width) / fx,
      my = (J_MARGIN * 0.5 * height) / fy;
    u.low.value.set(-(cx / fx + mx), -((height - cy) / fy + my));
    u.high.value.set((width - cx) / fx + mx, cy / fy + my);
    // Depth as the projection makes it of z: (P22 z + P23) / -z with z = -depth.
    u.depth_row.value.set(p[10], p[14]);
    u.near.value = Math.max(camera.near, NEAR);
    u.time.value = shown - meta.clip[0];
    this.material.uniformsNeedUpdate = true;
  };

  /// Moves the clock, once for all views of a frame.
  #tick(frame, now) {
    if (frame === this.#frame) return;
    this.#frame = frame;
    const { clip } = this.meta;
    // The page chooses the number of pixels: where frames are late, a lower rung is what helps here.
    const took = now - this.#frameAt;
    if (this.#playing && took < PAUSED) this.#ladder.frame(took, now, this.#stream.shown(this.renderedTime).rung);
    this.#frameAt = now;
    if (this.#sounds && this.#drawn) {
      this.#sounds = false;
      this.sound.load(this.#file).catch(() => {});
    }
    if (!this.#playing) {
      this.#hear(false);
      return this.#follower.set(this.#time, now, clip);
    }
    const step = Math.min((now - this.#now) / 1000 || 0, STEP_MAX);
    this.#now = now;
    const playable = this.#stream.playable(this.#time);
    if (playable) {
      const { time, ended } = advance(this.#time, step * this.#speed, this.#clip);
      this.#time = time;
      if (ended) this.#playing = false;
    }
    this.#hear(playable && this.#playing);
  }

  #hear(running) {
    this.sound?.follow(this.#time, { running, speed: this.#speed, epoch: this.#epoch });
  }

  get #clip() {
    const { clip, fps } = this.meta;
    return { first: clip[0], last: clip[1], frameTime: 1 / (fps || 30), loop: this.loop };
  }

  /// Requests the next order and returns the second that this image shows, which is that of the newest order.
  #follow(now) {
    const { clip } = this.meta,
      [first, last] = clip,
      time = Math.min(Math.max(this.#time, first), last);
    const ahead = this.#playing
      ? (ms) => advance(this.#time, ((ms - this.#now) / 1000) * this.#speed, this.#clip).time
      : this.#follower.at(clip);
    this.#stream.update(time, { playing: !!ahead, speed: this.#speed, loop: this.loop });
    const at = ahead && ((ms) => ((t) => (this.#stream.playable(t) ? t : null))(Math.min(ahead(ms), last)));
    this.#want(time, this.#stream.playable(time) ? at : HOLD, now);
    if (this.#schedule.fresh) this.#turn();
    if (this.#schedule.current) this.#schedule.rendered(now);
    this.#schedule.ask(now);
    return this.#schedule.current?.time ?? time;
  }

  #want(time, at, now) {
    this.#schedule.want({ time, at, epoch: this.#epochs, view: { cameraFromWorld: this.#scratch.rows } }, now);
  }

  #ordered({ orders: [{ order, count }], generation }) {
    if (this.#gone) return;
    const now = performance.now(),
      accepted = this.#schedule.arrived(now);
    if (accepted) {
      // The order is returned to the worker.
      if (!(this.#next.order?.length >= order.length)) this.#next.order = new Uint32Array(order.length);
      this.#next.order.set(order.subarray(0, count));
      Object.assign(this.#next, { count, generation });
    }
    this.#schedule.ask(now);
    for (const done of this.#waiting.splice(0)) done();
    if (accepted) this.#onchange();
  }

  /// Applies the latest order.
  #turn() {
    const { order, count, generation } = this.#next,
      u = this.material.uniforms,
      rows = Math.max(Math.ceil(count / ORDER_WIDTH), 1);
    if (u.order.value.image.height < rows) {
      u.order.value.dispose();
      u.order.value = orders(Math.max(rows, order.length / ORDER_WIDTH));
    }
    u.order.value.image.data.set(order.subarray(0, count));
    u.order.value.needsUpdate = true;
    u.count.value = this.#drawn = count;
    this.geometry.instanceCount = Math.ceil(count / BATCH);
    // What this order no longer names may be overwritten.
    this.#retired = this.#retired.filter((r) => r.generation > generation || (this.#rows.give(r.row, r.count), false));
  }

  // The stream gives pages to the renderer.

  /// A texture of 8192 rows, which every WebGL2 device of today has, holds 8 million Gaussians.
  capacity = 8192 * ROW * 32;

  addPalette({ id, degree, count, ranges, bytes }) {
    const per = (degree + 1) ** 2 - 1,
      rows = Math.ceil((count * per) / WIDTH),
      row = this.#paletteRows;
    const palette = this.#grown('palette', palettes, row + rows, row * WIDTH * 4);
    palette.image.data.set(paletteTexels(per, count, bytes, rows), row * WIDTH * 4);
    this.#paletteRows += rows;
    this.#palettes.set(id, { row, degree, ranges });
  }

  addPage(page, entry) {
    const { id, count, words: packed, headers } = page,
      rows = Math.ceil(count / ROW);
    let row = this.#rows.take(rows);
    if (row < 0) {
      const before = this.#rows.rows;
      this.#rows.grow(Math.max(2 * before, before + rows));
      row = this.#rows.take(rows);
    }
    const w = this.#grown('words', words, this.#rows.rows, Infinity),
      b = this.#grown('blocks', blocks, this.#rows.rows, Infinity);
    w.image.data.set(packed, row * WIDTH * 4);
    const texels = blockTexels(headers, rows, entry, this.#palettes.get(entry.palette), this.meta.clip[0]);
    b.image.data.set(texels, row * BLOCKS_WIDTH * 4);
    this.#pages.set(id, { row, count: rows });
    this.#order.add(page, entry, row);
  }

  addMask(id, mask) {
    if (this.#pages.has(id)) this.#order.mask(id, mask);
  }

  dropPage(id) {
    const page = this.#pages.get(id);
    if (!page) return;
    this.#pages.delete(id);
    this.#order.drop(id);
    this.#retired.push({ ...page, generation: this.#order.generation });
  }

  /// The texture of a uniform, marked as changed, with at least this many rows; the first `kept` numbers stay.
  #grown(name, make, rows, kept) {
    const u = this.material.uniforms[name],
      old = u.value;
    if (old.image.height < rows) {
      u.value = make(Math.max(rows, 2 * old.image.height));
      u.value.image.data.set(old.image.data.subarray(0, Math.min(kept, old.image.data.length)));
      old.dispose();
    }
    u.value.needsUpdate = true;
    return u.value;
  }
}

// Draws a moving scene with WebGPU: pages stay on the GPU as the file's own words, and everything that depends on the
// time or the view happens there (cull.wgsl, sort.wgsl, draw.wgsl). The CPU writes 160 bytes per frame, and the list of
// blocks, with the bits of their key masks, where the set of pages or the key times around this time change.

import { NEAR } from './camera.js';
import { LOW_PASS } from './constants.js';
import { SceneError } from './errors.js';
import { Flight } from './pace.js';
import { CULL, DRAW, PROJECT, RESIDENT, SHADE, SORT } from './shaders.js';
import './sort.worker.js';

const { KeyMask } = globalThis.splat4dSort;

/// Gaussians of a block, and words of a Gaussian (docs/format.md).
const BLOCK = 256;
const WORDS = 8;
/// Bytes of a block's words, of its header (struct BlockHeader) and of its records (struct Record: 32 a Gaussian).
const BLOCK_BYTES = BLOCK * WORDS * 4;
const HEADER_BYTES = 128;
/// Header numbers that are times on the scene clock: the GPU counts from the clip's start, where 32 bits are finest.
const TIMES = [6, 7, 8, 9];
const RECORD_BYTES = BLOCK * 32;
/// Bytes of a bit for each Gaussian of a block: a listed block's visible ones, and those that key masks admit.
const MASK_BYTES = BLOCK / 8;
const MASK_WORDS = MASK_BYTES / 4;
/// Pairs that a workgroup of sort.wgsl takes, digits of a pass, and 8-bit passes for 16-bit keys.
const SORT_BLOCK = 2048;
const DIGITS = 256;
const SHIFTS = [0, 8];
/// Place of the number of records in `arguments` (cull.wgsl), and byte offsets of the draw's and the scan's there.
const COUNT_INDEX = 3;
const DRAW_OFFSET = 16;
const SCAN_OFFSET = 32;
const ARGUMENT_BYTES = 48;
/// Bytes of a frame's four timestamps.
const TIME_BYTES = 32;
/// struct Frame in words; its first 32 are the View.
const FRAME_WORDS = 40;
const VIEW_WORDS = 32;
/// Constants of the renderer (CONVENTIONS.md).
const ALPHA_MIN = 1 / 255;
/// Workgroups along x; more along y. WebGPU's default limit is 65,535.
const GROUPS_X = 32768;
/// Initial capacity in blocks: one full page.
const FIRST_BLOCKS = 256;
/// Rows of a texture that is read back begin at multiples of this (WebGPU).
const ROW_BYTES = 256;
const CHANNELS = { color: 0, depth: 1, alpha: 2, flow: 3 };
const PICTURE_FORMAT = 'rgba16float';

/// Runs of consecutive slots: first fit, neighbours merge when freed.
class Runs {
  constructor(size) {
    this.size = size;
    this.free = size ? [[0, size]] : [];
  }
  take(n) {
    const i = this.free.findIndex((run) => run[1] >= n);
    if (i < 0) return -1;
    const run = this.free[i], at = run[0];
    run[0] += n;
    run[1] -= n;
    if (!run[1]) this.free.splice(i, 1);
    return at;
  }
  give(at, n) {
    let i = this.free.findIndex((run) => run[0] > at);
    if (i < 0) i = this.free.length;
    this.free.splice(i, 0, [at, n]);
    for (let k = Math.min(i, this.free.length - 2); k >= Math.max(0, i - 1); k--) {
      const [a, b] = [this.free[k], this.free[k + 1]];
      if (a[0] + a[1] === b[0]) {
        a[1] += b[1];
        this.free.splice(k + 1, 1);
      }
    }
  }
  grow(size) {
    const more = size - this.size;
    this.give(this.size, more);
    this.size = size;
  }
}

/// Names of drivers that compute on the processor.
const SOFTWARE = /swiftshader|llvmpipe|lavapipe|software|basic render/i;

export class WebGPUBackend {
  name = 'webgpu';
  stats = { resident: 0, active: 0, drawn: 0, sortMs: 0, drawMs: 0 };
  /// What the newest image shows: {time, epoch}; null before the first one of the scene. Culling and sorting run on the
  /// GPU in the frame that they are for, so that this is what `draw` was given.
  shown = null;
  /// Images that the graphics processor still works on.
  flight = new Flight();

  #canvas; #context; #device; #queue; #format; #pipelines; #onlost;
  #error = null;
  #gone = false;
  #maxBytes;
  // Fixed buffers, and those that grow: blocks (words, headers), palette, lists (one place a listed block).
  #b = {};
  #groups = null;
  #runs = new Runs(0);
  #listRoom = 0;
  #paletteUsed = 0;
  #palettes = new Map();
  #pages = new Map();
  #meta = { clip: [0, 0], sh_degree: 0 };
  // The blocks in the list hold for the time `at`, and for times in [from, to) that are after `after`, a key time.
  #list = { at: NaN, after: -Infinity, from: Infinity, to: -Infinity, blocks: 0 };
  #frame = new Float32Array(FRAME_WORDS);
  #frameBits = new Uint32Array(this.#frame.buffer);
  #last = new Uint32Array(FRAME_WORDS);
  #culled = { valid: false, channel: -1, flowScale: 0 };
  #drawnOnce = false;
  #picture = null;
  #pictureView = null;
  #timer = null;
  /// Counts that are being read; whether a later image's were left out for it.
  #reading = null;
  #missed = false;
  #rangeStart = new Uint32Array([0xffffffff, 0]);

  /// Throws SceneError where WebGPU is missing or refuses; the canvas can then still be used for WebGL2.
  /// `onlost(error)` is called at most once, when the device is lost or refuses a command; draw() then does nothing.
  /// `hardware`: also refuse where the processor computes WebGPU, which it does slower than WebGL2.
  static async create(canvas, { onlost, hardware = false } = {}) {
    const adapter = await navigator.gpu?.requestAdapter({ powerPreference: 'high-performance' }).catch(() => null);
    if (!adapter) {
      throw new SceneError('WebGPU is not available', '', 'Use a browser with WebGPU, or let the player use WebGL2.');
    }
    const { info = {} } = adapter;
    if (hardware && (info.isFallbackAdapter || SOFTWARE.test(`${info.architecture} ${info.description}`))) {
      throw new SceneError('WebGPU would run on the CPU', '', 'Let the player use WebGL2.');
    }
    // Everything fits the default limits; larger ones only allow more Gaussians and larger images.
    const requiredLimits = {};
    for (const name of ['maxStorageBufferBindingSize', 'maxBufferSize', 'maxTextureDimension2D']) {
      requiredLimits[name] = adapter.limits[name];
    }
    const requiredFeatures = ['timestamp-query'].filter((f) => adapter.features.has(f));
    const refused = (e) =>
      new SceneError('The graphics driver rejects WebGPU', e.message, 'Update it, or use WebGL2.', e);
    let device;
    try {
      device = await adapter.requestDevice({ requiredLimits, requiredFeatures });
    } catch (e) {
      throw refused(e);
    }
    device.pushErrorScope('out-of-memory');
    device.pushErrorScope('validation');
    let backend, failure;
    try {
      const format = navigator.gpu.getPreferredCanvasFormat();
      const pipelines = await makePipelines(device, format);
      backend = new WebGPUBackend(device, format, pipelines, onlost);
    } catch (e) {
      failure = e;
    }
    failure = (await device.popErrorScope()) ?? (await device.popErrorScope()) ?? failure;
    // The context last: a canvas that has one of WebGPU never gets another.
    const context = failure ? null : canvas.getContext('webgpu');
    if (!context) {
      device.destroy();
      throw refused(failure ?? new Error('the canvas already has a context of another type'));
    }
    backend.#attach(canvas, context);
    return backend;
  }

  /// Use create().
  constructor(device, format, pipelines, onlost) {
    this.#device = device;
    this.#queue = device.queue;
    this.#format = format;
    this.#pipelines = pipelines;
    this.#onlost = onlost;
    this.#maxBytes = Math.min(device.limits.maxStorageBufferBindingSize, device.limits.maxBufferSize);
    const { STORAGE, UNIFORM, COPY_DST, COPY_SRC, INDIRECT, MAP_READ, QUERY_RESOLVE } = GPUBufferUsage;
    this.#b.frame = this.#buffer(4 * FRAME_WORDS, UNIFORM | COPY_DST);
    this.#b.arguments = this.#buffer(ARGUMENT_BYTES, STORAGE | INDIRECT | COPY_SRC);
    this.#b.range = this.#buffer(8, STORAGE | COPY_DST);
    this.#b.readback = this.#buffer(ARGUMENT_BYTES + TIME_BYTES, MAP_READ | COPY_DST);
    SHIFTS.forEach((shift, i) => {
      this.#b[`pass${i}`] = this.#buffer(8, UNIFORM | COPY_DST);
      this.#queue.writeBuffer(this.#b[`pass${i}`], 0, new Uint32Array([shift, COUNT_INDEX]));
    });
    if (device.features.has('timestamp-query')) {
      this.#timer = device.createQuerySet({ type: 'timestamp', count: 4 });
      this.#b.times = this.#buffer(TIME_BYTES, QUERY_RESOLVE | COPY_SRC);
    }
    this.#roomForBlocks(FIRST_BLOCKS);
    this.#roomForPalette(BLOCK);
    this.#roomForList(FIRST_BLOCKS);
    device.lost.then((info) => {
      if (info.reason !== 'destroyed') this.#fail('The graphics device was lost', info.message);
    });
    device.onuncapturederror = (event) => {
      event.preventDefault();
      this.#fail('The graphics driver rejected a command', event.error.message);
    };
  }

  /// Bytes of Gaussian words that can be resident at most.
  get capacity() {
    return Math.floor(this.#maxBytes / BLOCK_BYTES) * BLOCK_BYTES;
  }

  /// Forgets all pages and palettes; `meta` is the file's JSON.
  setScene(meta) {
    this.#meta = meta;
    this.#pages.clear();
    this.#palettes.clear();
    this.#paletteUsed = 0;
    this.#runs = new Runs(this.#runs.size);
    this.stats.resident = 0;
    this.shown = null;
    this.#changed();
  }

  /// Uploads a palette; pages that name it and were here before take it up.
  addPalette({ id, degree, count, ranges, bytes }) {
    if (this.#palettes.has(id) || this.#gone) return;
    // From byte planes to a word a coefficient: three bytes that the shader reads together.
    const held = (degree + 1) ** 2 - 1;
    const words = new Uint32Array(held * count);
    for (let k = 0; k < held; k++) {
      const r = 3 * k * count, g = r + count, b = g + count;
      for (let i = 0; i < count; i++) words[i * held + k] = bytes[r + i] | bytes[g + i] << 8 | bytes[b + i] << 16;
    }
    const first = this.#paletteUsed;
    // Without space the pages show their base colours.
    if (!this.#roomForPalette(first + words.length)) return;
    this.#paletteUsed += words.length;
    this.#queue.writeBuffer(this.#b.palette, 4 * first, words);
    this.#palettes.set(id, { first, degree, count, ranges: Array.from(ranges) });
    for (const page of this.#pages.values()) if (page.palette === id) this.#writeHeaders(page);
    this.#changed();
  }

  /// Uploads a page; `entry` is its section. False: no space (see `capacity`), drop others first.
  addPage({ id, count, headers, words }, entry) {
    if (this.#gone) return false;
    this.dropPage(id);
    const blocks = Math.ceil(count / BLOCK);
    let at = this.#runs.take(blocks);
    if (at < 0 && this.#roomForBlocks(this.#runs.size + blocks)) at = this.#runs.take(blocks);
    if (at < 0) return false;
    const { from, to, tier, palette } = entry;
    const page = { id, count, blocks, at, from, to, tier, palette, mask: null };
    page.headers = new Float32Array(blocks * HEADER_BYTES / 4);
    for (let k = 0; k < blocks; k++) {
      page.headers.set(headers.subarray(24 * k, 24 * k + 24), 32 * k);
      for (const i of TIMES) page.headers[32 * k + i] = headers[24 * k + i] - this.#meta.clip[0];
    }
    this.#writeHeaders(page);
    this.#queue.writeBuffer(this.#b.words, at * BLOCK_BYTES, words, 0, count * WORDS);
    // All are admitted until a mask states otherwise; the place may have had one.
    const all = new Uint32Array(blocks * MASK_WORDS).fill(0xffffffff);
    this.#queue.writeBuffer(this.#b.admitted, at * MASK_BYTES, all);
    this.#pages.set(id, page);
    this.stats.resident += count;
    this.#changed();
    return true;
  }

  /// Key masks of a resident page: of SceneFile.mask, whose arrays are the backend's from now on.
  addMask(id, mask) {
    const page = this.#pages.get(id);
    if (!page || this.#gone) return;
    page.mask = new KeyMask(mask);
    this.#changed();
  }

  /// Frees a page's place; nothing happens where it is not resident.
  dropPage(id) {
    const page = this.#pages.get(id);
    if (!page) return;
    this.#pages.delete(id);
    this.#runs.give(page.at, page.blocks);
    this.stats.resident -= page.count;
    this.#changed();
  }

  /// Size of the drawing buffer, pixels; held within what the device can draw.
  resize(width, height) {
    const most = this.#device.limits.maxTextureDimension2D;
    const [w, h] = [width, height].map((v) => Math.max(1, Math.min(Math.round(v), most)));
    if (this.#picture && w === this.#canvas.width && h === this.#canvas.height) return;
    this.#canvas.width = w;
    this.#canvas.height = h;
    this.#makePicture();
  }

  /// Culls and sorts only where view, time or pages changed, and blends only where anything did; the canvas is always
  /// filled, because the browser may empty it once it was shown. Returns whether there is an image.
  draw({ time, epoch = 0, view, channel = 'color', background = [0, 0, 0], depthRange = [0, 1], flowScale = 1 }) {
    if (this.#gone) return false;
    const at = Math.min(Math.max(time, this.#meta.clip[0]), this.#meta.clip[1]);
    this.shown = { time: at, epoch };
    this.#select(at);
    this.#writeFrame({ time: at, view, channel, background, depthRange, flowScale });
    const bits = this.#frameBits, last = this.#last;
    let same = this.#drawnOnce, viewSame = this.#culled.valid;
    for (let i = 0; i < FRAME_WORDS; i++) {
      if (bits[i] !== last[i]) {
        same = false;
        if (i < VIEW_WORDS) viewSame = false;
      }
    }
    const kind = CHANNELS[channel], culled = this.#culled;
    const colors = kind === CHANNELS.depth || kind === CHANNELS.alpha || (culled.channel === kind
      && (kind !== CHANNELS.flow || culled.flowScale === flowScale));
    const encoder = this.#device.createCommandEncoder();
    const blocks = this.#list.blocks;
    const cull = blocks > 0 && !(viewSame && colors);
    if (!this.#groups) this.#makeGroups();
    if (cull) this.#cullAndSort(encoder, blocks);
    if (blocks === 0) this.stats.drawn = 0;
    if (!same || !viewSame) {
      last.set(bits);
      this.#queue.writeBuffer(this.#b.frame, 0, this.#frame);
      this.#blend(encoder, blocks > 0, cull);
    }
    const shown = this.#context.getCurrentTexture().createView();
    this.#resolve(encoder, shown, this.#pipelines.resolve, this.#groups.resolve);
    const measured = cull && this.#copyStats(encoder);
    const start = performance.now();
    this.#queue.submit([encoder.finish()]);
    this.flight.begin(start);
    this.#queue.onSubmittedWorkDone().catch(() => {}).then(() => this.flight.end(performance.now()));
    if (measured) this.#readStats(start);
    this.#drawnOnce = true;
    culled.valid = true;
    if (cull) {
      culled.channel = kind;
      culled.flowScale = flowScale;
    }
    return true;
  }

  /// Resolves when the last image and its `stats` are complete. Throws what the device complained about.
  async settled() {
    if (!this.#gone) await this.#queue.onSubmittedWorkDone();
    while (this.#reading) await this.#reading;
    if (this.#error) throw this.#error;
  }

  /// The last image: RGBA, rows from the top.
  async readPixels() {
    if (this.#error) throw this.#error;
    const { width, height } = this.#canvas, device = this.#device;
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC;
    const target = device.createTexture({ size: [width, height], format: 'rgba8unorm', usage });
    const bytesPerRow = Math.ceil(4 * width / ROW_BYTES) * ROW_BYTES;
    const buffer = this.#buffer(bytesPerRow * height, GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ);
    const encoder = device.createCommandEncoder();
    const pipeline = this.#pipelines.resolve8;
    this.#resolve(encoder, target.createView(), pipeline, this.#resolveGroup(pipeline));
    encoder.copyTextureToBuffer({ texture: target }, { buffer, bytesPerRow }, [width, height]);
    this.#queue.submit([encoder.finish()]);
    try {
      await buffer.mapAsync(GPUMapMode.READ);
      const rows = new Uint8Array(buffer.getMappedRange());
      const data = new Uint8ClampedArray(4 * width * height);
      for (let y = 0; y < height; y++) {
        data.set(rows.subarray(y * bytesPerRow, y * bytesPerRow + 4 * width), 4 * width * y);
      }
      return { width, height, data };
    } finally {
      buffer.destroy();
      target.destroy();
    }
  }

  /// For tests: the last frame's records (Float32Array, 8 a place, see struct Record) and their places, nearest first.
  async inspect() {
    const { arguments: args, records, places, keys } = this.#b;
    const [counts] = await this.#download([[args, ARGUMENT_BYTES]]);
    const n = counts[COUNT_INDEX];
    const lists = [[places, 4 * n], [keys, 4 * n], [records, this.#list.blocks * RECORD_BYTES]];
    const [order, sorted, all] = n ? await this.#download(lists) : [[], [], new Uint32Array(0)];
    return { order, keys: sorted, records: new Float32Array(all.buffer) };
  }

  destroy() {
    this.#gone = true;
    this.#context?.unconfigure();
    this.#device.destroy();
    this.#pages.clear();
  }

  #attach(canvas, context) {
    this.#canvas = canvas;
    this.#context = context;
    context.configure({ device: this.#device, format: this.#format, alphaMode: 'opaque' });
    this.#makePicture();
  }

  #fail(what, message) {
    if (this.#gone) return;
    this.#gone = true;
    this.#error = new SceneError(what, message, 'Reload the page, or let the player use WebGL2.');
    this.#onlost?.(this.#error);
  }

  /// The pages or their places are not what they were: the list and the image are out of date.
  #changed() {
    this.#list = { ...this.#list, at: NaN, from: Infinity };
    this.#culled.valid = false;
  }

  #buffer(size, usage) {
    return this.#device.createBuffer({ size, usage });
  }

  async #download(parts) {
    const encoder = this.#device.createCommandEncoder();
    const copies = parts.map(([from, size]) => {
      const to = this.#buffer(size, GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ);
      encoder.copyBufferToBuffer(from, 0, to, 0, size);
      return to;
    });
    this.#queue.submit([encoder.finish()]);
    return Promise.all(copies.map(async (buffer) => {
      await buffer.mapAsync(GPUMapMode.READ);
      const copy = new Uint32Array(buffer.getMappedRange().slice(0));
      buffer.destroy();
      return copy;
    }));
  }

  /// A storage buffer of `size` bytes that begins with the old one's content.
  #grown(old, size) {
    const { STORAGE, COPY_DST, COPY_SRC } = GPUBufferUsage;
    const made = this.#buffer(size, STORAGE | COPY_DST | COPY_SRC);
    this.#groups = null;
    if (old) {
      const encoder = this.#device.createCommandEncoder();
      encoder.copyBufferToBuffer(old, 0, made, 0, Math.min(old.size, size));
      this.#queue.submit([encoder.finish()]);
      old.destroy();
    }
    return made;
  }

  /// Ensures capacity for `least` blocks, at least twice as many as now where the device allows it. False: it does not.
  #roomForBlocks(least) {
    const most = Math.floor(this.#maxBytes / BLOCK_BYTES), now = this.#runs.size;
    if (least <= now) return true;
    if (least > most) return false;
    const size = Math.min(Math.max(least, 2 * now), most);
    this.#b.words = this.#grown(this.#b.words, size * BLOCK_BYTES);
    this.#b.blocks = this.#grown(this.#b.blocks, size * HEADER_BYTES);
    this.#b.admitted = this.#grown(this.#b.admitted, size * MASK_BYTES);
    this.#runs.grow(size);
    return true;
  }

  #roomForPalette(words) {
    const now = this.#b.palette?.size ?? 0;
    if (4 * words <= now) return true;
    if (4 * words > this.#maxBytes) return false;
    this.#b.palette = this.#grown(this.#b.palette, Math.min(Math.max(4 * words, 2 * now), this.#maxBytes & ~3));
    return true;
  }

  /// Buffers of one frame's lists. Their content is made again each time.
  #roomForList(blocks) {
    if (blocks <= this.#listRoom) return;
    const most = Math.floor(this.#maxBytes / RECORD_BYTES);
    const room = this.#listRoom = Math.min(Math.max(blocks, 2 * this.#listRoom), most);
    const sizes = {
      list: 4 * room,
      records: RECORD_BYTES * room,
      masks: MASK_BYTES * room,
      firsts: 4 * room,
      keys: 4 * BLOCK * room,
      places: 4 * BLOCK * room,
      keys2: 4 * BLOCK * room,
      places2: 4 * BLOCK * room,
      sums: 4 * DIGITS * (Math.ceil(BLOCK * room / SORT_BLOCK) + 1),
    };
    for (const [name, size] of Object.entries(sizes)) {
      this.#b[name]?.destroy();
      this.#b[name] = this.#grown(null, size);
    }
  }

  /// Fills the words behind the file's 24 (struct BlockHeader) and uploads a page's headers.
  #writeHeaders(page) {
    const f = page.headers, u = new Uint32Array(f.buffer);
    const palette = this.#palettes.get(page.palette);
    for (let k = 0; k < page.blocks; k++) {
      const o = 32 * k + 24;
      f[o] = page.to - page.from;
      u[o + 1] = Math.min(BLOCK, page.count - BLOCK * k);
      u[o + 2] = palette?.first ?? 0;
      u[o + 3] = palette?.degree ?? 0;
      for (let l = 0; l < 3; l++) f[o + 4 + l] = palette?.ranges[l] ?? 0;
      u[o + 7] = palette?.count ?? 1;
    }
    this.#queue.writeBuffer(this.#b.blocks, page.at * HEADER_BYTES, f);
  }

  /// Makes the list of blocks of the resident pages at time t, where the one there is does not hold.
  #select(t) {
    const old = this.#list;
    if (t === old.at || (t > old.after && t >= old.from && t < old.to)) return;
    let from = -Infinity, to = Infinity, after = -Infinity;
    const active = [];
    for (const page of this.#pages.values()) {
      for (const edge of [page.from, page.to]) {
        if (edge <= t) from = Math.max(from, edge);
        else to = Math.min(to, edge);
      }
      if (!(page.from <= t && t < page.to)) continue;
      active.push(page);
      if (!page.mask) continue;
      const [l, r] = page.mask.around(t).map((k) => page.mask.key(k));
      // On a key time its own bits count; between two, those of both.
      if (l === t || r === t) after = Infinity;
      else if (l < t) after = Math.max(after, l);
      if (r > t) to = Math.min(to, r);
      if (page.mask.at(t)) this.#queue.writeBuffer(this.#b.admitted, page.at * MASK_BYTES, page.mask.bits);
    }
    // Beyond what the device can list, the important tiers come first; the order of ids decides ties of depth.
    const most = Math.floor(this.#maxBytes / RECORD_BYTES);
    let blocks = 0;
    active.sort((a, b) => a.tier - b.tier || a.id - b.id);
    const listed = active.filter((page) => blocks + page.blocks <= most && ((blocks += page.blocks), true));
    listed.sort((a, b) => a.id - b.id);
    const list = new Uint32Array(blocks);
    let n = 0, gaussians = 0;
    for (const page of listed) {
      const bits = page.mask?.bits;
      for (let k = 0; k < page.blocks; k++) {
        // A block without admitted Gaussians is skipped.
        if (!bits || bits.subarray(MASK_WORDS * k, MASK_WORDS * (k + 1)).some((word) => word)) list[n++] = page.at + k;
      }
      gaussians += page.mask?.count ?? page.count;
    }
    this.#roomForList(n);
    if (n) this.#queue.writeBuffer(this.#b.list, 0, list, 0, n);
    this.#list = { at: t, after, from, to, blocks: n };
    this.stats.active = gaussians;
    this.#culled.valid = false;
  }

  /// struct Frame, as in cull.wgsl.
  #writeFrame({ time, view, channel, background, depthRange, flowScale }) {
    const f = this.#frame, u = this.#frameBits, m = view.cameraFromWorld;
    for (let c = 0; c < 4; c++) {
      for (let r = 0; r < 3; r++) f[4 * c + r] = m[4 * r + c];
      f[4 * c + 3] = c === 3 ? 1 : 0;
    }
    f[16] = view.fx;
    f[17] = view.fy;
    f[18] = view.cx;
    f[19] = view.cy;
    f[20] = view.width;
    f[21] = view.height;
    f[22] = view.near ?? NEAR;
    f[23] = LOW_PASS;
    for (let c = 0; c < 3; c++) f[24 + c] = -(m[c] * m[3] + m[4 + c] * m[7] + m[8 + c] * m[11]);
    f[27] = ALPHA_MIN;
    u[28] = this.#meta.sh_degree ?? 3;
    u[29] = this.#list.blocks;
    f[30] = time - this.#meta.clip[0];
    u[31] = 0;
    for (let c = 0; c < 3; c++) f[32 + c] = background[c];
    u[35] = CHANNELS[channel] ?? 0;
    f[36] = depthRange[0];
    f[37] = depthRange[1];
    f[38] = flowScale;
    u[39] = 0;
  }

  #cullAndSort(encoder, blocks) {
    const g = this.#groups, p = this.#pipelines, args = this.#b.arguments;
    this.#queue.writeBuffer(this.#b.range, 0, this.#rangeStart);
    encoder.clearBuffer(this.#b.masks, 0, MASK_BYTES * blocks);
    const timed = this.#timer && { querySet: this.#timer, beginningOfPassWriteIndex: 0, endOfPassWriteIndex: 1 };
    const pass = encoder.beginComputePass(timed ? { timestampWrites: timed } : undefined);
    const over = (name) => {
      pass.setPipeline(p[name]);
      pass.setBindGroup(0, g[name]);
      pass.dispatchWorkgroups(Math.min(blocks, GROUPS_X), Math.ceil(blocks / GROUPS_X));
    };
    over('cull');
    pass.setPipeline(p.total);
    pass.setBindGroup(0, g.total);
    pass.dispatchWorkgroups(1);
    over('keys');
    for (let i = 0; i < SHIFTS.length; i++) {
      pass.setPipeline(p.histogram);
      pass.setBindGroup(0, g.histogram[i]);
      pass.dispatchWorkgroupsIndirect(args, 0);
      pass.setPipeline(p.scan);
      pass.setBindGroup(0, g.scan[i]);
      pass.dispatchWorkgroupsIndirect(args, SCAN_OFFSET);
      pass.setPipeline(p.scatter);
      pass.setBindGroup(0, g.scatter[i]);
      pass.dispatchWorkgroupsIndirect(args, 0);
    }
    pass.end();
  }

  #blend(encoder, any, timed) {
    const timestampWrites = { querySet: this.#timer, beginningOfPassWriteIndex: 2, endOfPassWriteIndex: 3 };
    const pass = encoder.beginRenderPass({
      colorAttachments: [{ view: this.#pictureView, loadOp: 'clear', storeOp: 'store', clearValue: [0, 0, 0, 0] }],
      ...(timed && this.#timer ? { timestampWrites } : {}),
    });
    if (any) {
      pass.setPipeline(this.#pipelines.splat);
      pass.setBindGroup(0, this.#groups.splat);
      pass.drawIndirect(this.#b.arguments, DRAW_OFFSET);
    }
    pass.end();
  }

  #resolve(encoder, view, pipeline, group) {
    const colorAttachments = [{ view, loadOp: 'clear', storeOp: 'store', clearValue: [0, 0, 0, 1] }];
    const pass = encoder.beginRenderPass({ colorAttachments });
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, group);
    pass.draw(3);
    pass.end();
  }

  /// Copies counts and times to where they can be read, unless a reading is still in progress.
  #copyStats(encoder) {
    if ((this.#missed = !!this.#reading)) return false;
    encoder.copyBufferToBuffer(this.#b.arguments, 0, this.#b.readback, 0, ARGUMENT_BYTES);
    if (this.#timer) {
      encoder.resolveQuerySet(this.#timer, 0, 4, this.#b.times, 0);
      encoder.copyBufferToBuffer(this.#b.times, 0, this.#b.readback, ARGUMENT_BYTES, TIME_BYTES);
    }
    return true;
  }

  /// Without a timer drawMs is the time from the call (`start`, if known) to the image's end, sort included.
  #readStats(start) {
    const { readback } = this.#b, { stats } = this;
    this.#reading = readback.mapAsync(GPUMapMode.READ).then(() => {
      const data = readback.getMappedRange();
      stats.drawn = new Uint32Array(data, 0, COUNT_INDEX + 1)[COUNT_INDEX];
      if (this.#timer) {
        const t = new BigUint64Array(data, ARGUMENT_BYTES, 4);
        stats.sortMs = Number(t[1] - t[0]) / 1e6;
        stats.drawMs = Number(t[3] - t[2]) / 1e6;
      } else if (start) {
        stats.drawMs = performance.now() - start;
      }
      readback.unmap();
    }, () => {}).then(() => { // The device is lost; nothing is rendered any more.
      this.#reading = null;
      // No later image may come.
      if (!this.#missed || this.#gone) return;
      const encoder = this.#device.createCommandEncoder();
      this.#copyStats(encoder);
      this.#queue.submit([encoder.finish()]);
      this.#readStats();
    });
  }

  #makePicture() {
    const { width, height } = this.#canvas;
    this.#picture?.destroy();
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.TEXTURE_BINDING;
    this.#picture = this.#device.createTexture({ size: [width, height], format: PICTURE_FORMAT, usage });
    this.#pictureView = this.#picture.createView();
    this.#groups = null;
    this.#drawnOnce = false;
  }

  #group(pipeline, entries) {
    return this.#device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: Object.entries(entries).map(([binding, resource]) => ({
        binding: Number(binding),
        resource: resource instanceof GPUBuffer ? { buffer: resource } : resource,
      })),
    });
  }

  #resolveGroup(pipeline) {
    return this.#group(pipeline, { 0: this.#b.frame, 15: this.#pictureView });
  }

  #makeGroups() {
    const b = this.#b, p = this.#pipelines;
    const passes = [[b.keys, b.places, b.keys2, b.places2], [b.keys2, b.places2, b.keys, b.places]];
    const counting = (pipeline) => passes.map(([keys], i) =>
      this.#group(pipeline, { 0: b[`pass${i}`], 1: b.arguments, 2: keys, 6: b.sums }));
    this.#groups = {
      cull: this.#group(p.cull, {
        0: b.frame, 1: b.words, 2: b.blocks, 3: b.list, 4: b.palette, 5: b.records, 6: b.masks, 7: b.range,
        16: b.admitted,
      }),
      total: this.#group(p.total, { 0: b.frame, 6: b.masks, 8: b.arguments, 11: b.firsts }),
      keys: this.#group(p.keys, {
        0: b.frame, 5: b.records, 6: b.masks, 7: b.range, 9: b.keys, 10: b.places, 11: b.firsts,
      }),
      histogram: counting(p.histogram),
      scan: counting(p.scan),
      scatter: passes.map(([k, v, k2, v2], i) =>
        this.#group(p.scatter, { 0: b[`pass${i}`], 1: b.arguments, 2: k, 3: v, 4: k2, 5: v2, 6: b.sums })),
      splat: this.#group(p.splat, { 0: b.frame, 12: b.records, 13: b.places, 14: b.arguments }),
      resolve: this.#resolveGroup(p.resolve),
    };
  }
}

/// Compiles all pipelines at once, off the main thread where the browser can.
async function makePipelines(device, format) {
  const shared = RESIDENT + PROJECT + SHADE + CULL;
  const module = async (code) => {
    const made = device.createShaderModule({ code });
    const errors = (await made.getCompilationInfo()).messages.filter((m) => m.type === 'error');
    if (errors.length) throw new Error(`shader line ${errors[0].lineNum}: ${errors[0].message}`);
    return made;
  };
  const [cull, draw, sort] = await Promise.all([shared, shared + DRAW, SORT].map(module));
  const compute = (code, entryPoint) =>
    device.createComputePipelineAsync({ layout: 'auto', compute: { module: code, entryPoint } });
  const render = (vertex, fragment, target, topology) => device.createRenderPipelineAsync({
    layout: 'auto',
    vertex: { module: draw, entryPoint: vertex },
    fragment: { module: draw, entryPoint: fragment, targets: [target] },
    primitive: { topology },
  });
  const over = { srcFactor: 'one', dstFactor: 'one-minus-src-alpha', operation: 'add' };
  const made = {
    cull: compute(cull, 'cull'),
    total: compute(cull, 'total'),
    keys: compute(cull, 'keys_of_depths'),
    histogram: compute(sort, 'histogram'),
    scan: compute(sort, 'scan'),
    scatter: compute(sort, 'scatter'),
    splat: render('corner', 'splat', { format: PICTURE_FORMAT, blend: { color: over, alpha: over } }, 'triangle-list'),
    resolve: render('cover', 'resolve', { format }, 'triangle-list'),
    resolve8: render('cover', 'resolve', { format: 'rgba8unorm' }, 'triangle-list'),
  };
  const names = Object.keys(made);
  const done = await Promise.all(Object.values(made));
  return Object.fromEntries(names.map((name, i) => [name, done[i]]));
}

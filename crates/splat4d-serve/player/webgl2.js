// The WebGL2 backend: words in textures, order from a worker, blending in half floats where that is to be had. Every
// image shows the time that its order was computed for (schedule.js).

import { NEAR } from './camera.js';
import { SceneError } from './errors.js';
import { Rows, Timer, check, program, texture } from './gl.js';
import {
  BATCH,
  CHANNELS,
  DIRECT_VERTEX,
  DRAW_FRAGMENT,
  DRAW_VERTEX,
  ORDER_WIDTH,
  PROJECT_FRAGMENT,
  SHOW_FRAGMENT,
  SHOW_VERTEX,
} from './glsl.js';
import { Order } from './order.js';
import { Flight } from './pace.js';
import { Schedule } from './schedule.js';
import './sort.worker.js';
import { BLOCKS_WIDTH, J_MARGIN, WIDTH, blockTexels, corners, paletteTexels } from './texels.js';

const { ROW } = globalThis.splat4dSort;

/// Rows of the words' texture to begin with: 2 MiB each 64.
const FIRST_ROWS = 256;

export class WebGL2Backend {
  /// Throws SceneError where WebGL2 is not to be had. `onlost(SceneError)` is called when the browser takes it away,
  /// `onorder()` when the next `draw` has something new to show.
  static async create(canvas, { onlost, onorder } = {}) {
    return new WebGL2Backend(canvas, onlost, onorder);
  }

  name = 'webgl2';
  stats = { resident: 0, active: 0, drawn: 0, foveated: 0, sortMs: 0, drawMs: 0 };
  #canvas;
  #gl;
  #lost;
  #onorder;
  #destroyed = false;
  /// Programs: {program, at: places of uniforms}. `#project` is null where every corner computes its splat.
  #project = null;
  #draw;
  #show;
  /// Textures of words, block headers and palettes, and how their rows are lent. Texture: its greatest height.
  #words = null;
  #blocks;
  #palette;
  #maxRows;
  #rows = new Rows(0);
  #paletteRows = 0;
  #paletteHeight = 0;
  /// id → {row, rows, count}; id → {row, degree, ranges}.
  #pages = new Map();
  #palettes = new Map();
  /// Rows of dropped pages: [{row, count, generation}]. The order on the screen may still name them.
  #retired = [];
  #clip = [0, 0];
  /// The worker's orders, in two sets in turn: `#front` is rendered; the other one is rendered next, with its figures.
  /// A set has an order, or one for each eye. `#eye`: the one that is being rendered, its first `#count` numbers.
  #order;
  #orders = [0, 1].map(() => [0, 1].map(() => ({ texture: null, rows: 0, count: 0 })));
  #kinds = 1;
  #front = 0;
  #eye = 0;
  #count = 0;
  #next = null;
  #schedule;
  /// What PROJECT_FRAGMENT writes, and what is blended: {frame, texture(s), …}.
  #splats = null;
  #sums;
  #timer;
  /// Images that are being rendered, and what states that they are finished.
  #flight = new Flight();
  #fences = [];
  #size = [0, 0];
  /// Vertex arrays: none at all, and quads; the latter's corners.
  #empty;
  #quads;
  #corners;
  /// What the last `draw` was given, and the look of the newest image; null where that must be rendered again anyway.
  #last = null;
  #look = null;
  #waiting = [];

  constructor(canvas, onlost, onorder = () => {}) {
    this.#onorder = onorder;
    const options = {
      alpha: false,
      antialias: false,
      depth: false,
      stencil: false,
      powerPreference: 'high-performance',
    };
    const gl = canvas.getContext('webgl2', options);
    if (!gl)
      throw new SceneError(
        'This browser does not support WebGL2',
        '',
        'Turn on hardware acceleration, or use another browser.',
      );
    this.#canvas = canvas;
    this.#gl = gl;
    this.#lost = (event) => {
      event.preventDefault();
      if (this.#destroyed) return;
      this.#wake();
      onlost?.(new SceneError('The graphics device was lost', '', 'Reload the page.'));
    };
    canvas.addEventListener('webglcontextlost', this.#lost);
    const full = gl.getExtension('EXT_color_buffer_float');
    const float = full ?? gl.getExtension('EXT_color_buffer_half_float');
    this.#sums = { texture: null, frame: gl.createFramebuffer(), format: float ? gl.RGBA16F : gl.RGBA8 };
    this.#maxRows = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    /// Bytes of words that fit; half a row is lost at the end of a page on average.
    this.capacity = Math.floor(this.#maxRows * ROW * 32 * 0.98);
    // Splats are computed once each where 32-bit floats can be rendered to, else once a corner.
    if (full) {
      this.#project = program(gl, SHOW_VERTEX, PROJECT_FRAGMENT);
      this.#splats = { frame: gl.createFramebuffer(), textures: [], rows: 0 };
    }
    this.#draw = full ? program(gl, DRAW_VERTEX, DRAW_FRAGMENT) : program(gl, DIRECT_VERTEX, DRAW_FRAGMENT);
    this.#show = program(gl, SHOW_VERTEX, SHOW_FRAGMENT);
    this.#blocks = texture(gl, gl.RGBA32F, BLOCKS_WIDTH, this.#maxRows);
    this.#grow(FIRST_ROWS);
    this.#palette = texture(gl, gl.RGBA8UI, 1, 1);
    this.#empty = gl.createVertexArray();
    this.#quads = gl.createVertexArray();
    gl.bindVertexArray(this.#quads);
    this.#corners = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.#corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners(), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.#timer = new Timer(gl);
    this.#order = new Order(NEAR, (answer) => this.#ordered(answer));
    this.#schedule = new Schedule(this.#order);
    check(gl, 'Too little graphics memory to start');
  }

  /// The WebGL2 context (a headset's session needs it).
  get gl() {
    return this.#gl;
  }

  /// Begins another scene: resident pages are dropped.
  setScene(meta) {
    for (const id of [...this.#pages.keys()]) this.dropPage(id);
    this.#palettes.clear();
    this.#paletteRows = 0;
    this.#clip = meta.clip;
    this.#last = this.#look = null;
    this.#count = 0;
    this.#schedule.reset();
  }

  /// What the newest image shows: {time, epoch}; null before the first one of the scene.
  get shown() {
    return this.#schedule.shown;
  }

  /// Images that the graphics processor still works on: {count, ms: what the newest finished one took}.
  get flight() {
    const gl = this.#gl;
    while (this.#fences.length && gl.clientWaitSync(this.#fences[0], 0, 0) !== gl.TIMEOUT_EXPIRED) {
      gl.deleteSync(this.#fences.shift());
      this.#flight.end(performance.now());
    }
    return this.#flight;
  }

  /// `palette`: of SceneFile.palette.
  addPalette({ id, degree, count, ranges, bytes }) {
    const gl = this.#gl,
      per = (degree + 1) ** 2 - 1,
      rows = Math.ceil((count * per) / WIDTH);
    const row = this.#paletteRows;
    if (row + rows > this.#maxRows) throw new SceneError('Too many palettes for this graphics card');
    if (row + rows > this.#paletteHeight) {
      const height = Math.min(Math.max(row + rows, 2 * this.#paletteHeight), this.#maxRows);
      this.#palette = this.#enlarged(this.#palette, gl.RGBA8UI, row, height);
      this.#paletteHeight = height;
    }
    const texels = paletteTexels(per, count, bytes, rows);
    gl.bindTexture(gl.TEXTURE_2D, this.#palette);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, WIDTH, rows, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE, texels);
    check(gl, 'The graphics memory is full');
    this.#paletteRows += rows;
    this.#palettes.set(id, { row, degree, ranges });
  }

  /// `page`: of SceneFile.page, whose arrays are the backend's from now on. `entry`: its section.
  addPage(page, entry) {
    const gl = this.#gl,
      { id, count, words, headers } = page,
      rows = Math.ceil(count / ROW);
    let row = this.#rows.take(rows);
    if (row < 0) {
      this.#grow(Math.min(Math.max(2 * this.#rows.rows, this.#rows.rows + rows), this.#maxRows));
      row = this.#rows.take(rows);
    }
    if (row < 0) throw new SceneError('The graphics memory is full', '', 'Lower the memory budget.');
    const whole = Math.floor(count / ROW),
      rest = count % ROW;
    gl.bindTexture(gl.TEXTURE_2D, this.#words);
    const put = (y, width, height, at) =>
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, y, width, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words, at);
    if (whole) put(row, WIDTH, whole, 0);
    if (rest) put(row + whole, 2 * rest, 1, whole * ROW * 8);
    gl.bindTexture(gl.TEXTURE_2D, this.#blocks);
    gl.texSubImage2D(
      gl.TEXTURE_2D,
      0,
      0,
      row,
      BLOCKS_WIDTH,
      rows,
      gl.RGBA,
      gl.FLOAT,
      blockTexels(headers, rows, entry, this.#palettes.get(entry.palette), this.#clip[0]),
    );
    this.#pages.set(id, { row, rows, count });
    this.stats.resident += count;
    this.#order.add(page, entry, row);
  }

  /// `mask`: of SceneFile.mask, the key masks of a resident page; its arrays are the backend's from now on.
  addMask(id, mask) {
    if (!this.#pages.has(id)) return;
    this.#order.mask(id, mask);
  }

  dropPage(id) {
    const page = this.#pages.get(id);
    if (!page) return;
    this.#pages.delete(id);
    this.stats.resident -= page.count;
    this.#order.drop(id);
    this.#retired.push({ row: page.row, count: page.rows, generation: this.#order.generation });
  }

  /// Size of the drawing buffer, px.
  resize(width, height) {
    if (this.#size[0] === width && this.#size[1] === height && this.#sums.texture) return;
    [width, height] = [Math.max(width, 1), Math.max(height, 1)];
    this.#canvas.width = width;
    this.#canvas.height = height;
    this.#look = null;
    this.#room(width, height);
  }

  /// Renders the newest order at its time with the newest camera, and requests the next one: `time`, `at` and `epoch`
  /// are what Schedule.want takes. Returns false where there is nothing new to show, or no order yet; `force` renders
  /// what there is in any case. `target` {framebuffer, x, y}: where the image goes instead of the canvas (a headset's).
  /// `eyes`: the views of all images of this frame, of which this is number `eye`. `fovea`: of fovea.js. `background`
  /// null: nothing, premultiplied.
  draw({
    time, at = null, epoch = 0, view, channel = 'color', background = [0, 0, 0], depthRange = [0, 1], flowScale = 100,
    target = null, force = false, eyes = null, eye = 0, fovea = null,
  }) {
    const clamped = (t) => (t === null ? t : Math.min(Math.max(t, this.#clip[0]), this.#clip[1]));
    const now = performance.now();
    this.#last = { view, channel, background, depthRange, flowScale, target, moving: !!at, eye };
    this.#schedule.want({ time: clamped(time), at: at && ((ms) => clamped(at(ms))), epoch, view, eyes, fovea }, now);
    // First the order that is there: the request that follows takes the newest latency and camera.
    const drawn = this.#redraw(force || !!target);
    this.#schedule.ask(now);
    return drawn;
  }

  /// Resolves when the image of the last `draw` is there in its final order; while a clock runs, the next image.
  async settled() {
    while (this.#last && !this.#destroyed && !this.#gl.isContextLost() && this.#schedule.ask(performance.now())) {
      await new Promise((done) => this.#waiting.push(done));
      if (this.#last?.moving && this.#schedule.fresh) break;
    }
    this.#redraw(false);
  }

  /// The image of the last `draw`: {width, height, data: RGBA bytes, rows from the top}.
  async readPixels() {
    const gl = this.#gl,
      [width, height] = this.#size;
    const data = new Uint8ClampedArray(width * height * 4);
    if (!this.#last || !this.shown || gl.isContextLost()) return { width, height, data };
    const target = texture(gl, gl.RGBA8, width, height),
      frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
    this.#resolve(frame, 0, 0, 0);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(data.buffer));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteFramebuffer(frame);
    gl.deleteTexture(target);
    return { width, height, data };
  }

  destroy() {
    this.#destroyed = true;
    this.#order.destroy();
    this.#wake();
    this.#canvas.removeEventListener('webglcontextlost', this.#lost);
    const gl = this.#gl;
    for (const t of [this.#words, this.#blocks, this.#palette, this.#sums.texture]) gl.deleteTexture(t);
    for (const t of [...this.#orders.flat().map((o) => o.texture), ...(this.#splats?.textures ?? [])]) gl.deleteTexture(t);
    for (const a of [this.#empty, this.#quads]) gl.deleteVertexArray(a);
    gl.deleteBuffer(this.#corners);
    gl.deleteFramebuffer(this.#sums.frame);
    if (this.#splats) gl.deleteFramebuffer(this.#splats.frame);
    for (const p of [this.#project, this.#draw, this.#show]) gl.deleteProgram(p?.program ?? null);
  }

  // Textures

  #grow(rows) {
    this.#words = this.#enlarged(this.#words, this.#gl.RGBA32UI, this.#rows.rows, rows);
    this.#rows.grow(rows);
  }

  /// A texture of `height` rows with the first `kept` rows of `old`, which is deleted.
  #enlarged(old, format, kept, height) {
    const gl = this.#gl,
      grown = texture(gl, format, WIDTH, height);
    if (old && kept) {
      const frame = gl.createFramebuffer();
      gl.bindFramebuffer(gl.READ_FRAMEBUFFER, frame);
      gl.framebufferTexture2D(gl.READ_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, old, 0);
      gl.copyTexSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 0, 0, WIDTH, kept);
      gl.bindFramebuffer(gl.READ_FRAMEBUFFER, null);
      gl.deleteFramebuffer(frame);
    }
    try {
      check(gl, 'The graphics memory is full');
    } catch (e) {
      gl.deleteTexture(grown);
      throw e;
    }
    if (old) gl.deleteTexture(old);
    return grown;
  }

  #room(width, height) {
    const gl = this.#gl,
      sums = this.#sums;
    gl.deleteTexture(sums.texture);
    sums.texture = texture(gl, sums.format, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, sums.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, sums.texture, 0);
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && sums.format !== gl.RGBA8) {
      sums.format = gl.RGBA8;
      return this.#room(width, height);
    }
    this.#size = [width, height];
  }

  // Order

  #ordered({ orders, active, left, ms, generation }) {
    const now = performance.now();
    if (this.#gl.isContextLost()) return this.#wake();
    if (!this.#schedule.arrived(now)) {
      this.#schedule.ask(now);
      return this.#wake();
    }
    orders.forEach((made, k) => this.#keep(made, this.#orders[1 - this.#front][k]));
    this.#next = { kinds: orders.length, active, left, ms, generation };
    this.#schedule.ask(now);
    this.#wake();
    this.#onorder();
  }

  /// Writes an order into the texture of `back`.
  #keep({ order, count }, back) {
    const gl = this.#gl,
      rows = Math.ceil(count / ORDER_WIDTH);
    if (back.rows < rows) {
      gl.deleteTexture(back.texture);
      // Space for all resident pages, so that it does not grow in small steps.
      back.rows = Math.min(Math.max(order.length / ORDER_WIDTH, 2 * back.rows), this.#maxRows);
      back.texture = texture(gl, gl.R32UI, ORDER_WIDTH, back.rows);
    }
    if (rows) {
      gl.bindTexture(gl.TEXTURE_2D, back.texture);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ORDER_WIDTH, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, order, 0);
    }
    back.count = count;
  }

  #wake() {
    for (const done of this.#waiting.splice(0)) done();
  }

  // Images

  /// Renders the current order, unless the newest image shows it so already; `force`: in any case. Returns whether it
  /// did.
  #redraw(force) {
    const last = this.#last,
      gl = this.#gl,
      schedule = this.#schedule;
    if (!last || this.#destroyed || gl.isContextLost()) return false;
    const { target } = last;
    // Without an order the canvas keeps its image; a headset's frame begins empty.
    if (!schedule.current && !target) return false;
    const view = schedule.current && !target ? schedule.viewOf(last.view) : last.view;
    const look = [...view.cameraFromWorld, view.fx, view.fy, view.cx, view.cy, view.width, view.height, view.near,
      last.channel, ...(last.background ?? []), ...last.depthRange, last.flowScale].join();
    if (!force && !schedule.fresh && look === this.#look) return false;
    this.#look = target ? null : look;
    const begin = performance.now();
    if (schedule.fresh) this.#turn();
    if (schedule.current) schedule.rendered(begin);
    this.#eye = Math.min(last.eye, this.#kinds - 1);
    this.#count = schedule.current ? this.#orders[this.#front][this.#eye].count : 0;
    this.#timer.begin();
    const { width, height } = view;
    if (this.#size[0] !== width || this.#size[1] !== height) this.#room(width, height);
    if (this.#count && this.#project) this.#projected(view);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.#sums.frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (this.#count) this.#blend(view);
    this.#resolve(target?.framebuffer ?? null, target?.x ?? 0, target?.y ?? 0, height);
    this.#timer.end();
    const fence = target ? null : gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    if (fence) {
      this.#fences.push(fence);
      this.#flight.begin(begin);
      gl.flush();
    }
    // Where the browser reports nothing, at least the time of submission.
    this.stats.drawMs = this.#timer.ms || performance.now() - begin;
    return true;
  }

  /// Applies the latest order.
  #turn() {
    const { kinds, active, left, ms, generation } = this.#next;
    this.#front = 1 - this.#front;
    this.#kinds = kinds;
    Object.assign(this.stats, { active, drawn: this.#orders[this.#front][0].count, foveated: left, sortMs: ms });
    // What this order no longer names may be overwritten.
    this.#retired = this.#retired.filter((r) => r.generation > generation || (this.#rows.give(r.row, r.count), false));
  }

  /// Gives `made` (a program that computes splats) the view, and the textures it reads.
  #setView({ program, at }, view) {
    const gl = this.#gl,
      { channel, depthRange, flowScale } = this.#last,
      { time } = this.#schedule.current,
      m = view.cameraFromWorld;
    const { width, height, fx, fy, cx, cy } = view;
    gl.useProgram(program);
    this.#bind(at, 'words', 0, this.#words);
    this.#bind(at, 'blocks', 1, this.#blocks);
    this.#bind(at, 'palette', 2, this.#palette);
    this.#bind(at, 'order', 3, this.#orders[this.#front][this.#eye].texture);
    for (let k = 0; k < 9; k++) SCRATCH[k] = m[4 * (k % 3) + Math.floor(k / 3)];
    gl.uniformMatrix3fv(at.rotation, false, SCRATCH);
    gl.uniform3f(at.translation, m[3], m[7], m[11]);
    const eye = (k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11]);
    gl.uniform3f(at.eye, eye(0), eye(1), eye(2));
    gl.uniform2f(at.focal, fx, fy);
    gl.uniform2f(at.center, cx, cy);
    gl.uniform2f(at.size, width, height);
    const mx = (J_MARGIN * 0.5 * width) / fx,
      my = (J_MARGIN * 0.5 * height) / fy;
    gl.uniform2f(at.low, -(cx / fx + mx), -(cy / fy + my));
    gl.uniform2f(at.high, (width - cx) / fx + mx, (height - cy) / fy + my);
    gl.uniform2f(at.depth_range, depthRange[0], depthRange[1]);
    gl.uniform1f(at.time, time - this.#clip[0]);
    gl.uniform1f(at.near, view.near ?? NEAR);
    gl.uniform1f(at.flow_scale, flowScale);
    gl.uniform1i(at.channel, CHANNELS[channel]);
    if (at.count) gl.uniform1i(at.count, this.#count);
  }

  #bind(at, name, unit, bound) {
    const gl = this.#gl;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, bound);
    gl.uniform1i(at[name], unit);
    gl.activeTexture(gl.TEXTURE0);
  }

  /// Computes every splat of the order, a texel each.
  #projected(view) {
    const gl = this.#gl,
      splats = this.#splats,
      rows = Math.ceil(this.#count / ORDER_WIDTH);
    gl.bindFramebuffer(gl.FRAMEBUFFER, splats.frame);
    if (splats.rows < rows) {
      for (const t of splats.textures) gl.deleteTexture(t);
      splats.rows = this.#orders[this.#front][this.#eye].rows;
      const points = [0, 1, 2].map((k) => gl.COLOR_ATTACHMENT0 + k);
      splats.textures = points.map((point) => {
        const made = texture(gl, gl.RGBA32F, ORDER_WIDTH, splats.rows);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, point, gl.TEXTURE_2D, made, 0);
        return made;
      });
      gl.drawBuffers(points);
    }
    gl.viewport(0, 0, ORDER_WIDTH, rows);
    this.#setView(this.#project, view);
    gl.bindVertexArray(this.#empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /// Blends the splats over one another, the farthest first.
  #blend(view) {
    const gl = this.#gl,
      { program, at } = this.#draw,
      [width, height] = this.#size;
    if (this.#project) {
      gl.useProgram(program);
      gl.uniform2f(at.size, width, height);
      ['shapes', 'places', 'tints'].forEach((name, i) => this.#bind(at, name, i, this.#splats.textures[i]));
    } else {
      this.#setView(this.#draw, view);
    }
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.#quads);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH, gl.UNSIGNED_SHORT, 0, Math.ceil(this.#count / BATCH));
    gl.disable(gl.BLEND);
  }

  /// Writes the sums as an image; `turned`: its height where rows run from the bottom.
  #resolve(framebuffer, x, y, turned) {
    const gl = this.#gl,
      { program, at } = this.#show,
      { background, channel } = this.#last;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(x, y, this.#size[0], this.#size[1]);
    gl.useProgram(program);
    gl.bindVertexArray(this.#empty);
    gl.bindTexture(gl.TEXTURE_2D, this.#sums.texture);
    gl.uniform1i(at.sums, 0);
    gl.uniform3fv(at.background, background ?? [0, 0, 0]);
    gl.uniform1f(at.opaque, background ? 1 : 0);
    gl.uniform2i(at.origin, x, y);
    gl.uniform1i(at.turned, turned);
    gl.uniform1i(at.channel, CHANNELS[channel]);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}

const SCRATCH = new Float32Array(9);

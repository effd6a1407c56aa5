// The player without a face: clock, camera, streaming, choice of the backend, resolution and figures. It draws only
// when something has changed.

import { Camera, NEAR, bounds, clamp, datasetCamera, dot, add, firstCamera, linkText } from './camera.js';
import { Controls } from './controls.js';
import { Pace } from './pace.js';
import { SceneError } from './errors.js';
import { SceneFile } from './scene-file.js';
import { Stream } from './stream.js';
import { Track } from './track.js';

export const CHANNELS = ['color', 'depth', 'alpha', 'flow'];
export const SPEED_RANGE = [0.1, 4];
/** Where pictures are drawn without a GPU, the first one should not take seconds either. */
const SCALE_SOFTWARE = 0.5;
/** Pictures that may be on their way in WebGPU's queue: more would only be shown later. */
const FLYING_MAX = 2;
/** Pixel ratios above 2 cost a lot and show nothing. */
const RATIO_MAX = 2;
/** Share of a moment's Gaussians below which playing waits: the most important tier makes a fair picture. */
const ENOUGH = 0.25;
/** Longest a reload keeps the old picture while pages of the new arrive, ms. */
const HOLD = 1500;
/** Seconds of a camera's way to a new place. */
const GLIDE = 0.5;
/** Longest step of the clock, s: a tab that slept goes on where it was. */
const STEP_MAX = 0.25;
/** A still picture is refined twice: after a rest, ms, as far as one drawing should take at most so long, ms. */
const REFINE = [[300, 400], [1500, 4000]];
/** A move of half the picture's height in a second shows at full strength in the flow view. */
const FLOW_SHARE = 0.5;
/** Beyond this share of the way to what is looked at nothing is cut off. */
const NEAR_SHARE = 0.2;
/** A device that is lost more often than this within a minute is given up. */
const LOSSES = 3;
/** Points of the clip at which the buffer bar asks what is there, and how often, ms. */
const BUFFER_POINTS = 100;
const BUFFER_EVERY = 250;

export class Player extends EventTarget {
  camera = new Camera();
  channel = 'color';
  /** {colors: labels as colours, only: number of the label that alone is seen, or null}. */
  labels = { colors: false, only: null };
  background = null;
  state = 'empty';
  time = 0;
  playing = false;
  waiting = false;
  loop = true;
  meta = null;
  file = null;
  backend = null;
  backendName = 'auto';
  /** 'auto', or a fixed share 0.25..1 of the screen's own pixels. */
  resolution = 'auto';
  /** The camera path being edited or played. */
  track = new Track();
  /** {track, seconds, frozen, loop} while a path plays. */
  film = null;
  buffered = [];
  figures = { firstFrame: 0 };
  #speed = 1;
  #pace = new Pace();
  #interval = 0;
  #stream = null;
  #run = 0;
  #abort = null;
  #dirty = true;
  /** How often the still picture was refined. */
  #refined = 0;
  #dirtyAt = 0;
  #paintedScale = 0;
  #flying = 0;
  #awake = 0;
  #due = 0;
  /** Milliseconds that a picture at full resolution would take. */
  #cost = 0;
  #drawnAt = 0;
  #last = 0;
  #glide = null;
  #held = 0;
  #losses = [];
  #seen = true;
  #bufferAt = 0;
  #frame = 0;
  #told = { time: null };
  #xr = false;
  #starting = null;
  #still = null;

  constructor(stage) {
    super();
    this.stage = stage;
    const player = this;
    this.controls = new Controls(stage, {
      get camera() { return player.camera; },
      get radius() { return player.radius; },
      loosen: () => this.#leave(),
      moved: () => this.#cameraMoved(),
    });
    this.#newCanvas();
    this.resizes = new ResizeObserver(() => this.redraw());
    this.resizes.observe(stage);
    this.sight = new IntersectionObserver(list => { this.#seen = list.at(-1).isIntersecting; this.redraw(); });
    this.sight.observe(stage);
    // Frames that a hidden tab left out were not slow.
    this.sleeps = () => { this.#interval = this.#awake = 0; };
    document.addEventListener('visibilitychange', this.sleeps);
    const loop = now => { this.#frame = requestAnimationFrame(loop); this.#tick(now); };
    this.#frame = requestAnimationFrame(loop);
  }

  emit(name, detail = {}) { this.dispatchEvent(new CustomEvent(name, { detail })); }

  get radius() { return bounds(this.meta).radius; }
  get first() { return this.meta?.clip[0] ?? 0; }
  get last() { return this.meta?.clip[1] ?? 0; }
  get frameTime() { return 1 / (this.meta?.fps || 30); }
  get duration() { return this.last - this.first; }
  get still() { return this.duration <= 0; }
  get speed() { return this.#speed; }
  set speed(x) {
    this.#speed = clamp(+x || 1, ...SPEED_RANGE);
    this.emit('ratechange');
  }
  get scale() { return this.resolution === 'auto' ? this.#pace.scale : this.resolution; }

  redraw() { this.#dirty = true; }

  // Loading.

  /** Opens a scene (address, File, Blob or bytes); `keep` leaves camera, time and playing as they are. */
  async load(source, { keep = false, start = {} } = {}) {
    const run = ++this.#run;
    this.#abort?.abort();
    this.#abort = new AbortController();
    const began = performance.now();
    keep &&= !!this.file;
    if (!keep || this.state === 'error') this.#become('loading');
    let file;
    try {
      [file] = await Promise.all([
        SceneFile.open(source, { signal: this.#abort.signal }),
        this.prepare(),
      ]);
      if (run !== this.#run) return file.close();
      this.#adopt(file, { keep, start });
      if (!keep) this.#poster(file, run);
      this.figures.opened = performance.now() - began;
      await this.#firstPicture(run, began, keep);
      if (run === this.#run) this.emit('load', { meta: file.meta, milliseconds: this.figures.firstFrame });
    } catch (error) {
      if (run !== this.#run || error.name === 'AbortError') return;
      // A new version that cannot be had leaves the old one where it is.
      if (keep && this.state === 'ready') this.emit('trouble', { error });
      else this.fail(error, source);
    }
  }

  #adopt(file, { keep, start }) {
    if (keep) this.#freeze();
    this.#stream?.destroy();
    this.file?.close();
    this.file = file;
    this.meta = file.meta;
    if (!keep) this.labels = { colors: false, only: null };
    this.#attach();
    this.#held = keep ? performance.now() + HOLD : 0;
    if (keep) this.time = clamp(this.time, this.first, this.last);
    else {
      this.time = clamp(start.time ?? this.first, this.first, this.last);
      this.film = null;
      this.camera = firstCamera(this.meta);
      if (start.camera) this.camera.set(start.camera);
      this.track = Track.fromMeta(this.meta.path, this.camera) ?? new Track();
      this.playing = !!start.playing && !this.still;
      if (CHANNELS.includes(start.channel)) this.channel = start.channel;
    }
    this.redraw();
    this.emit('scene');
    if (this.playing && !keep) this.emit('play');
    this.emit('camerachange', { camera: this.camera.toJSON() });
  }

  /** The picture of now stays over the canvas until the next scene has one of its own. */
  #freeze() {
    if (!this.#stream || !this.canvas.width) return;
    // A canvas can be copied only in the task that drew it.
    this.#paint(this.scale);
    this.#still?.remove();
    const still = this.#still = document.createElement('canvas');
    [still.width, still.height] = [this.canvas.width, this.canvas.height];
    still.getContext('2d').drawImage(this.canvas, 0, 0);
    this.canvas.after(still);
  }

  /** Gives the scene to the backend, at first and after a lost device. */
  #attach() {
    this.backend.setScene(this.meta);
    // Phones end pages that take more than some hundred MB, and not all of them say what they have.
    const budget = matchMedia('(pointer: coarse)').matches ? { budget: 2 ** 27 } : {};
    this.#stream = new Stream(this.file, this.backend, {
      ...budget,
      onchange: () => { this.redraw(); this.#bufferAt = 0; },
      onerror: error => this.#pageFailed(error),
      onleft: gaussians => this.emit('leftout', { gaussians }),
      show: this.labels.colors || this.labels.only !== null ? this.labels : null,
    });
  }

  async #poster(file, run) {
    const blob = await file.poster().catch(() => null);
    if (blob && run === this.#run && this.state === 'loading') this.emit('poster', { blob });
  }

  async #firstPicture(run, began, keep) {
    for (let shown = null, since = began; !shown || shown !== this.backend;) {
      await new Promise(done => setTimeout(done, 16));
      if (run !== this.#run || this.state === 'error') return;
      if (this.#drawnAt <= since) continue;
      shown = this.backend;
      try { await shown?.settled(); } catch (error) {
        // What is wrong with one backend another may do.
        since = performance.now();
        if (shown === this.backend) await this.#lost(error);
        shown = null;
      }
    }
    if (run !== this.#run || this.state === 'error') return;
    if (!keep) this.figures.firstFrame = performance.now() - began;
    this.#still?.remove();
    this.#become('ready');
  }

  #pageFailed(error) {
    if (error.name === 'AbortError') return;
    // What is resident goes on playing; only a scene of which nothing can be shown becomes an error page.
    if (this.state === 'ready') this.emit('trouble', { error });
    else this.fail(error);
  }

  fail(error, source) {
    this.#still?.remove();
    const where = typeof source === 'string' ? source : source?.name;
    const told = error instanceof SceneError ? error : Object.assign(new SceneError(
      error.message || String(error), where ?? 'player',
      'Try again; if it comes back, try another browser and tell us about it.'), { cause: error });
    this.playing = false;
    this.#become('error');
    this.emit('error', { error: told, what: told.what, where: told.where, remedy: told.remedy });
  }

  #become(state) {
    if (this.state === state) return;
    this.state = state;
    this.emit('statechange', { state });
  }

  // The backend.

  #newCanvas() {
    const canvas = document.createElement('canvas');
    canvas.setAttribute('aria-hidden', 'true');
    if (this.canvas) this.canvas.replaceWith(canvas);
    else this.stage.prepend(canvas);
    this.canvas = canvas;
    this.#told.size = null;
  }

  /** Starts the backend, which may be done ahead of the scene. */
  prepare() {
    return this.#starting ??= this.#makeBackend().catch(error => {
      this.#starting = null;
      throw error;
    });
  }

  /**
   * WebGPU on a graphics card, else WebGL2, else WebGPU on the processor; a canvas that one of them has touched is of no
   * use to another.
   */
  async #makeBackend() {
    // A second loss makes WebGPU the less likely of the two.
    const auto = this.#losses.length > 1 ? ['webgl2', 'webgpu'] : ['card', 'webgl2', 'webgpu'];
    const wanted = this.backendName === 'auto' ? auto : [this.backendName];
    const reasons = [];
    for (const name of wanted) {
      const { canvas } = this;
      const onlost = reason => canvas === this.canvas && this.#lost(reason);
      try {
        if (name !== 'webgl2') {
          if (!navigator.gpu) throw new Error(isSecureContext ? 'not offered' : 'needs https or this computer');
          this.backend = await (await import('./webgpu.js')).WebGPUBackend.create(this.canvas, {
            onlost, hardware: name === 'card',
          });
        } else this.backend = await (await import('./webgl2.js')).WebGL2Backend.create(this.canvas, { onlost });
        this.figures.fallback = reasons.join('; ');
        if (software(this.backend.gl)) this.#pace.scale = SCALE_SOFTWARE;
        return this.emit('backend', { name: this.backend.name });
      } catch (error) {
        reasons.push(`${name === 'webgl2' ? 'WebGL2' : 'WebGPU'}: ${error.what ?? error.message}`);
        this.#newCanvas();
      }
    }
    throw new SceneError('This browser cannot draw the scene', reasons.join('; '),
      'Turn on hardware acceleration in its settings, or open the page in a current Chrome, Edge, Firefox or Safari.');
  }

  /** Another backend for the same scene. */
  async useBackend(name) {
    this.backendName = name;
    if (!this.backend || (name !== 'auto' && this.backend.name === name)) return;
    await this.#rebuild();
  }

  async #lost(reason) {
    const now = performance.now();
    this.figures.lost = reason?.message ?? String(reason);
    this.#losses = this.#losses.filter(t => now - t < 60000).concat(now);
    if (this.#losses.length > LOSSES) {
      return this.fail(new SceneError('The graphics device was lost again and again', reason?.message ?? 'GPU',
        'Close other pages that use the GPU, lower the resolution, then load the page again.'));
    }
    await this.#rebuild().catch(error => this.fail(error));
  }

  async #rebuild() {
    this.#stream?.destroy();
    this.#stream = null;
    const old = this.backend;
    this.backend = this.#starting = null;
    this.#flying = 0;
    try { old?.destroy(); } catch { /* A lost device may refuse; it is gone anyway. */ }
    this.#newCanvas();
    try {
      await this.prepare();
      if (this.file) this.#attach();
    } catch (error) { this.fail(error); }
    this.redraw();
  }

  // Time.

  play() {
    if (this.still || !this.file) return;
    if (!this.loop && this.time >= this.last - 1e-6) this.seek(this.first);
    if (!this.playing) { this.playing = true; this.emit('play'); }
  }

  pause() {
    if (this.playing) { this.playing = false; this.emit('pause'); }
    this.waiting = false;
  }

  toggle() { this.playing ? this.pause() : this.play(); }

  seek(time) {
    if (!isFinite(time)) return;
    this.time = clamp(time, this.first, this.last);
    this.redraw();
  }

  /** To the next frame's or an earlier frame's very time. */
  step(frames) {
    this.pause();
    const at = Math.round((this.time - this.first) / this.frameTime);
    this.seek(this.first + (at + frames) * this.frameTime);
  }

  ready(time) { return this.#stream?.ready(time) ?? 0; }

  setChannel(channel) {
    if (!CHANNELS.includes(channel)) return;
    this.channel = channel;
    this.redraw();
    this.emit('channelchange', { channel });
  }

  /** Shows labels as colours, or one label (its name) alone; both may be. Names that there are not are none. */
  setLabels({ colors = false, only = null } = {}) {
    const at = this.meta?.labels.indexOf(only) ?? -1;
    this.labels = { colors: !!colors, only: at < 0 ? null : at };
    if (this.file && this.backend) {
      this.#stream?.destroy();
      this.#attach();
    }
    this.redraw();
    this.emit('labelschange', { colors: this.labels.colors, only: at < 0 ? null : only });
  }

  // The camera.

  #leave() {
    this.#glide = null;
    if (this.film) this.stopFilm();
    this.camera.loosen(this.canvas.width, this.canvas.height);
    this.viewed = null;
  }

  #cameraMoved() {
    this.redraw();
    this.#told.camera = true;
  }

  /** Puts the camera somewhere, gliding there unless motion is unwelcome. */
  setCamera(to, { glide = false } = {}) {
    this.controls.still();
    if (this.film) this.stopFilm();
    this.viewed = null;
    const camera = to instanceof Camera ? to.clone() : this.camera.clone().set(to);
    if (glide && this.controls.swing && this.file) {
      this.#glide = { from: this.camera.clone(), to: camera, u: 0 };
      this.#glide.from.loosen(this.canvas.width, this.canvas.height);
    } else {
      this.#glide = null;
      this.camera = camera;
    }
    this.#cameraMoved();
  }

  /** One of the capture's cameras, by number. */
  view(i) {
    const list = this.meta?.cameras ?? [];
    if (!list.length) return;
    const n = (i + list.length) % list.length;
    this.setCamera(datasetCamera(this.meta, list[n]), { glide: true });
    this.viewed = n;
    this.emit('viewed', { name: list[n].name, number: n });
  }

  reset() { this.setCamera(firstCamera(this.meta), { glide: true }); }

  /** Orbits about what is in the picture's middle from now on, at the scene's own distance. */
  setMode(mode) {
    this.controls.mode = mode;
    if (mode === 'orbit') {
      const ahead = dot(add(bounds(this.meta).center, this.camera.position, -1), this.camera.forward);
      if (ahead > 0.1 * this.radius) this.camera.distance = ahead;
    }
    this.emit('mode');
  }

  /** Plays the path; frozen, time stands still meanwhile (bullet time), on a turn about the target if there is none. */
  playFilm({ frozen = false } = {}) {
    if (!this.file) return;
    const track = this.track.keys.length > 1 ? this.track : frozen ? Track.turn(this.camera) : null;
    if (!track) return;
    this.controls.still();
    this.#glide = null;
    this.film = { track, seconds: 0, frozen, back: this.camera.clone() };
    if (frozen) this.pause();
    this.emit('film');
  }

  stopFilm() {
    this.film = null;
    this.emit('film');
  }

  // A frame.

  #tick(now) {
    const dt = Math.min((now - this.#last) / 1000, STEP_MAX);
    this.#last = now;
    // A picture that takes long makes the next frame late, also one that the backend draws by itself.
    const at = performance.now();
    let gap = this.#awake ? at - this.#awake : 0;
    this.#awake = at;
    if (this.backend) gap = Math.max(gap, this.#graphicsMs);
    this.#cost = Math.max(gap / (this.#paintedScale || 1) ** 2, this.#due ? this.#cost / 2 : this.#cost);
    this.#due = 0;
    if (!this.file || !this.backend || !this.#stream || this.#xr || this.state === 'error') return;
    this.controls.tick(dt);
    this.#moveCamera(dt);
    this.#moveTime(dt);
    this.#stream.update(this.time, { playing: this.playing, speed: this.#speed, loop: this.loop });
    this.#draw(now);
    this.#tell(now);
  }

  #moveCamera(dt) {
    if (this.#glide) {
      const g = this.#glide;
      g.u = Math.min(1, g.u + dt / GLIDE);
      this.camera = Camera.between(g.from, g.to, g.u * g.u * (3 - 2 * g.u));
      if (g.u >= 1) this.#glide = null;
      this.#cameraMoved();
    }
    const film = this.film;
    if (!film) return;
    film.seconds += dt;
    const over = film.seconds >= film.track.seconds;
    if (over && this.loop && film.track.seconds > 0) film.seconds %= film.track.seconds;
    const { camera, sceneTime } = film.track.at(film.seconds);
    this.camera = camera;
    if (!film.frozen && sceneTime !== null) {
      this.time = clamp(sceneTime, this.first, this.last);
      this.playing = false;
    }
    this.#cameraMoved();
    if (over && !this.loop) this.stopFilm();
  }

  #moveTime(dt) {
    if (!this.playing || this.state !== 'ready') return;
    const waiting = this.#stream.ready(this.time) < ENOUGH;
    if (waiting !== this.waiting) { this.waiting = waiting; this.emit('waiting', { waiting }); }
    if (waiting) return;
    let t = this.time + dt * this.#speed;
    // The last frame is shown as long as the others.
    const end = this.last + this.frameTime;
    if (t >= end || (!this.loop && t >= this.last)) {
      if (this.loop) t = this.first + (t - this.first) % (end - this.first);
      else { t = this.last; this.pause(); this.emit('ended'); }
    }
    this.time = t;
    this.redraw();
  }

  /** Time as it is shown: within the clip also while the last frame stands. */
  get shown() { return Math.min(this.time, this.last); }

  #draw(now) {
    const ready = this.#stream.ready(this.time);
    if (this.state === 'loading' && ready <= 0) return this.emit('progress', { ready });
    if (this.#held) {
      if (ready < 0.999 && now < this.#held) return;
      this.#held = 0;
      this.redraw();
    }
    if (!this.#dirty) this.#refine(now);
    if (!this.#dirty || !this.#seen) { this.#interval = 0; return; }
    if (this.#flying >= FLYING_MAX) return;
    this.#dirty = false;
    this.#dirtyAt = now;
    this.#refined = 0;
    this.#measure(now);
    this.#paint(this.scale);
  }

  /** What stands still is shown better than what moves. */
  #refine(now) {
    const [rest, budget] = REFINE[this.#refined] ?? [Infinity];
    const moving = this.playing || this.film || this.controls.busy;
    if (this.resolution !== 'auto' || moving || now - this.#dirtyAt < rest || !this.#seen) return;
    this.#refined++;
    const scale = Math.min(1, Math.sqrt(budget / (this.#cost || 1)));
    if (scale > this.#paintedScale) this.#paint(scale);
  }

  #paint(scale) {
    this.#paintedScale = scale;
    const ratio = Math.min(devicePixelRatio || 1, RATIO_MAX) * scale;
    const { clientWidth, clientHeight } = this.stage;
    if (!clientWidth || !clientHeight) return;
    const size = [clientWidth, clientHeight].map(x => Math.max(1, Math.round(x * ratio)));
    if (this.#told.size !== size.join()) {
      this.#told.size = size.join();
      this.backend.resize(...size);
    }
    const { backend } = this;
    try { backend.draw(this.drawing(...size)); } catch (error) { return this.#lost(error); }
    if (backend.name === 'webgpu') {
      this.#flying++;
      backend.settled().catch(() => {}).then(() => { if (backend === this.backend) this.#flying--; });
    }
    this.#drawnAt = this.#due = performance.now();
  }

  /** What the newest picture took where the browser's frames do not show it: WebGPU's commands wait in a queue. */
  get #graphicsMs() {
    const { name, stats } = this.backend;
    return name === 'webgpu' ? stats.drawMs + stats.sortMs : 0;
  }

  /** What a backend is told to draw now, at a size in px. */
  drawing(width, height, camera = this.camera) {
    const { center, radius } = bounds(this.meta);
    const middle = dot(add(center, camera.position, -1), camera.forward);
    // The capture's cameras saw no haze right before them. Who comes closer to look at something wants to see it.
    const least = this.meta.near ?? NEAR;
    const near = camera.lens ? least : Math.min(least, NEAR_SHARE * camera.distance);
    return {
      time: this.shown, view: { ...camera.view(width, height), near }, channel: this.channel,
      background: this.background ?? this.meta.background,
      depthRange: [Math.max(middle - radius, 0.02 * radius), Math.max(middle, 0) + radius],
      flowScale: FLOW_SHARE * height,
    };
  }

  #measure(now) {
    const ms = Math.max(now - this.#interval, this.#graphicsMs);
    if (this.#interval && this.state === 'ready') this.#pace.frame(ms, now, this.resolution !== 'auto');
    this.#interval = now;
  }

  #tell(now) {
    if (this.#told.time !== this.shown) {
      this.#told.time = this.shown;
      this.emit('timeupdate', { time: this.shown });
    }
    if (this.#told.camera) {
      this.#told.camera = false;
      this.emit('camerachange', { camera: this.camera.toJSON() });
    }
    if (now - this.#bufferAt > BUFFER_EVERY) {
      this.#bufferAt = now;
      this.#buffer();
      this.emit('progress', { ready: this.#stream.ready(this.time) });
    }
  }

  /** The spans of the clip that could be played now without waiting, as shares of it. */
  #buffer() {
    const out = [];
    for (let i = 0; i < BUFFER_POINTS && !this.still; i++) {
      const [a, b] = [i / BUFFER_POINTS, (i + 1) / BUFFER_POINTS];
      if (this.#stream.ready(this.first + (a + b) / 2 * this.duration) < ENOUGH) continue;
      if (out.at(-1)?.[1] === a) out.at(-1)[1] = b;
      else out.push([a, b]);
    }
    this.buffered = out;
  }

  // What others ask for.

  /** A PNG of the picture, as shown but always at full resolution. */
  async screenshot() {
    if (!this.file || !this.backend) {
      throw new SceneError('There is no picture yet', 'screenshot', 'Wait for the scene.');
    }
    this.#paint(1);
    await this.backend.settled();
    const { width, height, data } = await this.backend.readPixels();
    const canvas = new OffscreenCanvas(width, height);
    canvas.getContext('2d').putImageData(new ImageData(data, width, height), 0, 0);
    this.redraw();
    return canvas.convertToBlob({ type: 'image/png' });
  }

  /** Resolves when this moment is complete and drawn. */
  async settled() {
    await this.#stream?.settled(this.time);
    await new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)));
    await this.backend?.settled();
  }

  link() { return linkText({ camera: this.camera, time: this.shown, channel: this.channel, playing: this.playing }); }

  get statistics() {
    const { width, height } = this.canvas;
    const { fps, frameMs } = this.#pace;
    return {
      ...this.figures, fps, frameMs, atRest: performance.now() - this.#dirtyAt > 1000, ...this.backend?.stats,
      backend: this.backend?.name ?? null, width, height, scale: this.scale,
      gaussians: this.meta?.gaussians ?? 0, ready: this.ready(this.time),
      leftOut: this.#stream?.left ?? 0, bytesRead: this.file?.bytesRead ?? 0, bytesTotal: this.file?.bytesTotal ?? 0,
    };
  }

  /** While a headset draws, the page does not. */
  set immersed(on) { this.#xr = on; this.#told.size = null; this.redraw(); }
  advance(dt) {
    this.#moveTime(dt);
    this.#stream?.update(this.time, { playing: this.playing, speed: this.#speed, loop: this.loop });
  }

  destroy() {
    cancelAnimationFrame(this.#frame);
    this.#run++;
    this.#abort?.abort();
    document.removeEventListener('visibilitychange', this.sleeps);
    this.resizes.disconnect();
    this.sight.disconnect();
    this.#stream?.destroy();
    this.backend?.destroy();
    this.file?.close();
    this.file = null;
  }
}

/** Whether WebGL says that it is computed on the CPU. */
function software(gl) {
  const asked = gl?.getExtension?.('WEBGL_debug_renderer_info');
  return !!asked && /swiftshader|llvmpipe|software|basic render/i.test(gl.getParameter(asked.UNMASKED_RENDERER_WEBGL));
}

// The player without a face: clock, camera, streaming, choice of the backend, resolution and figures. It renders only
// when something has changed. `clock` runs; `time` is what the newest image shows (schedule.js).

import { Camera, NEAR, bounds, clamp, datasetCamera, dot, add, firstCamera, linkText } from './camera.js';
import { SPEED_RANGE, STEP_MAX } from './constants.js';
import { Controls } from './controls.js';
import { Cost, Pace, software } from './pace.js';
import { SceneError, cutShort } from './errors.js';
import { Ladder, rungOf } from './ladder.js';
import { SceneFile } from './scene-file.js';
import { advance } from './schedule.js';
import { Sound } from './sound.js';
import { Stream } from './stream.js';
import { Track } from './track.js';

export const CHANNELS = ['color', 'depth', 'alpha', 'flow'];
/** Where images are drawn without a GPU, the first one should not take seconds either. */
const SCALE_SOFTWARE = 0.5;
/**
 * Images that the graphics processor may work on: more would only be shown later. Two keep a fast one busy; where one takes
 * longer than `SLOW`, ms, the second would only make what follows late.
 */
const FLYING_MAX = 2, SLOW = 40;
/** Pixel ratios above 2 cost a lot and show nothing. */
const RATIO_MAX = 2;
/** Longest that the first image of a scene waits for more than the coarsest tiers, ms: a poster or the last image is sharp. */
const PATIENCE = 3000;
/** Seconds of a camera's way to a new place. */
const GLIDE = 0.5;
/**
 * An image at rest is rendered at full resolution: with the next frame when the clock stops, so long after the camera's last
 * move, ms. Where one frame would take longer than `AT_ONCE`, a camera that may move on gets a quick one of `FIRST_STEP`
 * first, and the next so long after it, ms.
 */
const REST = 150, AT_ONCE = 1000, FIRST_STEP = 400, NEXT_STEP = 300;
/** What changed: only what is shown, or that something moves as well, which then counts as not at rest. */
const CONTENT = 1, MOTION = 2;
/** Marks a clock that waits for pages: no other time can be rendered. */
const HOLD = () => null;
/** A move of half the image's height in a second shows at full strength in the flow view. */
const FLOW_SHARE = 0.5;
/** Beyond this share of the distance to the target nothing is cut off. */
const NEAR_SHARE = 0.2;
/** A device that is lost more often than this within a minute is given up. */
const LOSSES = 3;
/** Points of the clip that the buffer bar samples, and the interval, ms. */
const BUFFER_POINTS = 100;
const BUFFER_EVERY = 250;

export class Player extends EventTarget {
  camera = new Camera();
  channel = 'color';
  /** {colors: labels as colours, only: number of the label that alone is seen, or null}. */
  labels = { colors: false, only: null };
  background = null;
  state = 'empty';
  /** Where the clock is, s; the image follows it (`time`). */
  clock = 0;
  playing = false;
  /** The clock waits because pages of its time are missing. */
  waiting = false;
  loop = true;
  sound = new Sound();
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
  ladder = new Ladder();
  figures = { firstFrame: 0, frames: 0 };
  #speed = 1;
  #pace = new Pace();
  #interval = 0;
  #stream = null;
  #run = 0;
  #abort = null;
  #dirty = MOTION;
  /** When something last moved, and whether the quick image of one at rest is rendered. */
  #movedAt = 0;
  #quick = false;
  #paintedScale = 0;
  #cost = new Cost();
  #drawnAt = 0;
  /** Jumps and stops of the clock. */
  #epoch = 0;
  /** When the coarsest tiers of the first image were there. */
  #coarseAt = 0;
  #last = 0;
  #glide = null;
  #held = 0;
  #losses = [];
  #seen = true;
  #bufferAt = 0;
  #frame = 0;
  #told = { time: null };
  #xr = false;
  #pin = null;
  #starting = null;
  /** The last image of the previous scene, and its time. */
  #still = null;
  #stillTime = null;

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
    // Frames that a hidden tab left out were not slow, and its clock was stopped.
    this.sleeps = () => { this.#interval = this.#last = 0; };
    document.addEventListener('visibilitychange', this.sleeps);
    this.sound.addEventListener('volumechange', () => this.emit('volumechange'));
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
    this.#stop();
    this.#speed = clamp(+x || 1, ...SPEED_RANGE);
    this.emit('ratechange');
  }
  get scale() { return this.resolution === 'auto' ? this.#pace.scale : this.resolution; }

  /** The second that the newest image shows; before the first one, where the clock is. */
  get time() { return this.backend?.shown?.time ?? this.#stillTime ?? Math.min(this.clock, this.last); }
  /** Whether the image of a jump of the clock is pending. */
  get seeking() { return !!this.backend?.shown && this.backend.shown.epoch !== this.#epoch; }

  /** Where the image is or will be next: where a step or a slider continues. */
  get target() { return this.seeking ? this.clock : this.time; }

  /** Renders again, as something that moves; `what` CONTENT: static. */
  redraw(what = MOTION) { this.#dirty = Math.max(this.#dirty, what); }

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
      file.watch(() => this.load(source, { keep: true }));
      if (!keep) this.#poster(file, run);
      // What is there plays; that it is not all is an error all the same.
      if (file.truncated) this.emit('trouble', { error: cutShort(file, source), lasting: true });
      this.figures.opened = performance.now() - began;
      await this.#firstPicture(run, began, keep);
      if (run !== this.#run) return;
      this.emit('load', { meta: file.meta, milliseconds: this.figures.firstFrame });
      this.sound.load(file).catch(error => { if (run === this.#run) this.#pageFailed(error); });
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
    this.ladder = Object.assign(new Ladder(file.meta.ladder), { pinned: this.#pin });
    if (!keep) Object.assign(this, { labels: { colors: false, only: null } }).sound.drop();
    this.#attach();
    this.#held = keep ? performance.now() + PATIENCE : 0;
    this.#epoch++;
    this.#coarseAt = 0;
    if (keep) this.clock = clamp(this.clock, this.first, this.last);
    else {
      this.clock = clamp(start.time ?? this.first, this.first, this.last);
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

  /** The image of now stays over the canvas until the next scene has one of its own. */
  #freeze() {
    // A canvas can be copied only in the task that rendered it.
    if (!this.#stream || !this.#paintedScale || !this.#paint(this.#paintedScale, { force: true })) return;
    this.#still?.remove();
    this.#stillTime = this.time;
    const still = this.#still = document.createElement('canvas');
    [still.width, still.height] = [this.canvas.width, this.canvas.height];
    still.getContext('2d').drawImage(this.canvas, 0, 0);
    this.canvas.after(still);
  }

  /** Gives the scene to the backend, at first and after a lost device. */
  #attach() {
    this.backend.setScene(this.meta);
    // Phones end pages that take more than some hundred MB, and not all of them report their memory.
    const budget = matchMedia('(pointer: coarse)').matches ? { budget: 2 ** 27 } : {};
    this.#stream = new Stream(this.file, this.backend, {
      ...budget,
      onchange: () => { this.redraw(CONTENT); this.#bufferAt = 0; },
      onerror: error => this.#pageFailed(error),
      onleft: gaussians => this.emit('leftout', { gaussians }),
      show: this.labels.colors || this.labels.only !== null ? this.labels : null, ladder: this.ladder,
    });
  }

  async #poster(file, run) {
    const blob = await file.poster().catch(() => null);
    if (blob && run === this.#run && this.state === 'loading') this.emit('poster', { blob });
  }

  /** Passes the clock of this very moment to the sound. */
  #hear() {
    const late = (performance.now() - this.#last) / 1000 * this.#speed;
    const running = this.playing && !this.waiting && this.state === 'ready';
    this.sound.follow(this.clock + late, { running, speed: this.#speed, epoch: this.#epoch });
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
    this.#become('ready');
  }

  #pageFailed(error) {
    if (error.name === 'AbortError') return;
    // What is resident continues playing; only a scene of which nothing can be shown becomes an error page.
    if (this.state === 'ready') this.emit('trouble', { error });
    else this.fail(error);
  }

  fail(error, source) {
    this.#still?.remove();
    this.#stillTime = null;
    const where = typeof source === 'string' ? source : source?.name;
    const told = error instanceof SceneError ? error : Object.assign(new SceneError(
      error.message || String(error), where ?? 'player',
      'Try again. If it happens again, try another browser and report it.'), { cause: error });
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
      const onorder = () => this.redraw(CONTENT);
      try {
        if (name !== 'webgl2') {
          if (!navigator.gpu) throw new Error(isSecureContext ? 'not supported' : 'needs https or localhost');
          this.backend = await (await import('./webgpu.js')).WebGPUBackend.create(this.canvas, {
            onlost, hardware: name === 'card',
          });
        } else this.backend = await (await import('./webgl2.js')).WebGL2Backend.create(this.canvas, { onlost, onorder });
        this.figures.fallback = reasons.join('; ');
        this.#cost = new Cost();
        if (software(this.backend.gl)) this.#pace.scale = SCALE_SOFTWARE;
        return this.emit('backend', { name: this.backend.name });
      } catch (error) {
        reasons.push(`${name === 'webgl2' ? 'WebGL2' : 'WebGPU'}: ${error.what ?? error.message}`);
        this.#newCanvas();
      }
    }
    throw new SceneError('This browser cannot render the scene', [...new Set(reasons)].join('; '),
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
      return this.fail(new SceneError('The graphics device was lost several times', reason?.message ?? 'GPU',
        'Close other pages that use the GPU, lower the resolution, then reload the page.'));
    }
    await this.#rebuild().catch(error => this.fail(error));
  }

  async #rebuild() {
    this.#stream?.destroy();
    this.#stream = null;
    const old = this.backend;
    this.backend = this.#starting = null;
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
    if (!this.loop && this.clock >= this.last - 1e-6) this.seek(this.first);
    if (!this.playing) { this.playing = true; this.emit('play'); }
  }

  /** Stops at the image that is shown. */
  pause() {
    if (!this.playing) return;
    this.#stop();
    this.playing = false;
    this.emit('pause');
  }

  /** A running clock continues from what is shown: images that were requested ahead are not rendered. */
  #stop() {
    if (!this.playing && !this.film) return;
    if (!this.seeking) this.clock = this.time;
    this.#epoch++;
    this.#movedAt = -Infinity;
    // A step of the clock that is not rendered yet is none any more.
    this.#dirty = CONTENT;
  }

  toggle() { this.playing ? this.pause() : this.play(); }

  seek(time) {
    if (!isFinite(time)) return;
    this.clock = clamp(time, this.first, this.last);
    this.#epoch++;
    this.redraw();
  }

  /** To the next frame's or an earlier frame's very time. */
  step(frames) {
    this.pause();
    const at = Math.round((this.target - this.first) / this.frameTime);
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
      this.#freeze();
      this.#stream?.destroy();
      this.#attach();
      this.#held = performance.now() + PATIENCE;
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

  /** Orbits about what is in the image's middle from now on, at the scene's own distance. */
  setMode(mode) {
    this.controls.mode = mode;
    if (mode === 'orbit') {
      const ahead = dot(add(bounds(this.meta).center, this.camera.position, -1), this.camera.forward);
      if (ahead > 0.1 * this.radius) this.camera.distance = ahead;
    }
    this.emit('mode');
  }

  /** Plays the path; frozen, time is stopped meanwhile (bullet time), on a turn about the target if there is none. */
  playFilm({ frozen = false } = {}) {
    if (!this.file) return;
    const track = this.track.keys.length > 1 ? this.track : frozen ? Track.turn(this.camera) : null;
    if (!track) return;
    this.controls.still();
    this.#glide = null;
    this.pause();
    this.film = { track, seconds: 0, frozen, back: this.camera.clone() };
    this.#epoch++;
    this.emit('film');
  }

  stopFilm() {
    if (!this.film?.frozen) this.#stop();
    this.film = null;
    this.emit('film');
  }

  // A frame.

  #tick(now) {
    const dt = this.#last ? Math.min((now - this.#last) / 1000, STEP_MAX) : 0;
    this.#last = now;
    if (!this.file || !this.backend || !this.#stream || this.#xr || this.state === 'error') return;
    this.controls.tick(dt);
    this.#moveCamera(dt);
    this.#moveTime(dt);
    this.#hear();
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
    if (!this.waiting) film.seconds += dt;
    const over = film.seconds >= film.track.seconds;
    film.seconds = this.#filmSeconds(0);
    const { camera, sceneTime } = film.track.at(film.seconds);
    this.camera = camera;
    if (!film.frozen && sceneTime !== null) {
      this.clock = clamp(sceneTime, this.first, this.last);
      this.playing = false;
    }
    this.#cameraMoved();
    if (!over || this.loop) return;
    // It ends at its end; what was requested ahead lies before it.
    this.film = null;
    this.emit('film');
  }

  /** Second of the film's path in `ahead` seconds. */
  #filmSeconds(ahead) {
    const { seconds, track } = this.film, t = seconds + ahead;
    if (t < track.seconds) return t;
    return this.loop && track.seconds > 0 ? t % track.seconds : track.seconds;
  }

  #moveTime(dt) {
    this.#stream.update(this.clock, { playing: this.playing, speed: this.#speed, loop: this.loop });
    const waiting = !this.#stream.playable(this.clock);
    if (waiting !== this.waiting) { this.waiting = waiting; this.emit('waiting', { waiting }); }
    if (!this.playing || waiting || this.state !== 'ready') return;
    const { time, ended } = advance(this.clock, dt * this.#speed, this.#clip);
    this.clock = time;
    this.redraw();
    if (!ended) return;
    this.playing = false;
    this.emit('pause');
    this.emit('ended');
  }

  get #clip() { return { first: this.first, last: this.last, frameTime: this.frameTime, loop: this.loop }; }

  /** Whether the clock runs, freely or along a path. */
  get #running() { return this.state === 'ready' && (this.playing || (!!this.film && !this.film.frozen)); }

  /** Where the clock will be at `ms` of performance.now(); null where no image of that can be rendered yet. */
  #ahead = ms => {
    const seconds = this.#last ? Math.max(0, (ms - this.#last) / 1000) : 0;
    const along = this.film && this.film.track.at(this.#filmSeconds(seconds)).sceneTime;
    const t = this.film ? along ?? this.clock : advance(this.clock, seconds * this.#speed, this.#clip).time;
    const time = clamp(t, this.first, this.last);
    return this.#stream.playable(time) ? time : null;
  };

  #draw(now) {
    const { waiting } = this, ready = this.#stream.ready(this.clock, this.state === 'loading' ? 0 : undefined);
    if (this.state === 'loading') {
      if (!waiting) this.#coarseAt ||= now;
      if (waiting || (ready < 0.999 && now - this.#coarseAt < PATIENCE)) return this.emit('progress', { ready });
    }
    if (this.#held) {
      if (waiting || (ready < 0.999 && now < this.#held)) return;
      this.#held = 0;
      this.redraw();
    }
    if (!this.#seen) { this.#interval = 0; return; }
    // While pages of the clock's time are missing, the last whole image stays.
    if (waiting && !this.#stream.playable(this.time)) return;
    const { count = 0, ms = 0 } = this.backend.flight ?? {};
    if (count >= (ms > SLOW ? 1 : FLYING_MAX)) return;
    const moving = this.playing || this.film || this.#glide || this.controls.busy;
    if (moving || this.#dirty === MOTION) {
      // A clock that stops later is at rest at once.
      this.#movedAt = this.#dirty === MOTION && !this.playing ? now : -Infinity;
      this.#quick = false;
    }
    const scale = moving ? this.scale : this.#restScale(now);
    const dirty = this.#dirty || (scale > this.#paintedScale && !moving);
    this.#dirty = 0;
    if (dirty && this.#paint(scale) && moving) this.#measure(now);
    if (!moving) this.#interval = 0;
  }

  /** Share of the screen's pixels for a static image. */
  #restScale(now) {
    const { scale } = this;
    if (this.resolution !== 'auto') return scale;
    if (this.#movedAt === -Infinity) return 1;
    if (now - this.#movedAt < REST) return scale;
    const least = Math.max(scale, this.#paintedScale);
    if (this.#cost.at(1) <= AT_ONCE) return 1;
    if (this.#quick) return now - this.#drawnAt < NEXT_STEP ? this.#paintedScale : 1;
    this.#quick = true;
    return this.#cost.within(FIRST_STEP, least);
  }

  /** Renders at a share of the screen's pixels; returns whether there was something to render. */
  #paint(scale, { force = false } = {}) {
    const ratio = Math.min(devicePixelRatio || 1, RATIO_MAX) * scale;
    const { clientWidth, clientHeight } = this.stage;
    if (!clientWidth || !clientHeight) return false;
    const size = [clientWidth, clientHeight].map(x => Math.max(1, Math.round(x * ratio)));
    const { backend } = this;
    if (backend.flight?.ms && this.state === 'ready') this.#cost.record(this.#paintedScale, backend.flight.ms);
    if (this.#told.size !== size.join()) {
      this.#told.size = size.join();
      backend.resize(...size);
    }
    this.#paintedScale = scale;
    try {
      if (backend.draw({ ...this.drawing(...size), force }) === false) return false;
    } catch (error) {
      this.#lost(error);
      return false;
    }
    this.#drawnAt = performance.now();
    // The image of the previous scene is removed with the first one of the next.
    if (!force) {
      this.#still?.remove();
      this.#stillTime = null;
    }
    this.#tellTime();
    return true;
  }

  /** Nearest and farthest distance of the depth view, scene units. */
  depthRange(camera = this.camera) {
    const { center, radius } = bounds(this.meta);
    const middle = dot(add(center, camera.position, -1), camera.forward);
    return [Math.max(middle - radius, 0.02 * radius), Math.max(middle, 0) + radius];
  }

  /** What a backend is to render now, at a size in px. */
  drawing(width, height, camera = this.camera) {
    // The capture's cameras saw no haze right before them. A viewer who moves closer must see it.
    const least = this.meta.near ?? NEAR;
    const near = camera.lens ? least : Math.min(least, NEAR_SHARE * camera.distance);
    // While pages are missing, what is shown stays, seen by the newest camera.
    const { waiting } = this, time = waiting ? this.time : Math.min(this.clock, this.last);
    const epoch = waiting ? this.backend.shown?.epoch : this.#epoch;
    return {
      time, epoch, at: waiting ? HOLD : this.#running ? this.#ahead : null,
      view: { ...camera.view(width, height), near }, channel: this.channel,
      background: this.background ?? this.meta.background,
      depthRange: this.depthRange(camera),
      flowScale: FLOW_SHARE * height,
    };
  }

  #measure(now) {
    if (this.#interval && this.state === 'ready') {
      const fixed = this.resolution !== 'auto';
      this.#pace.frame(now - this.#interval, now, fixed);
      this.frameTook(now - this.#interval, now, { stuck: fixed || this.#pace.stuck(now) });
    }
    this.#interval = now;
  }

  /** A frame took `ms`: a device that is too slow renders a lower rung (`Ladder.frame`). */
  frameTook(ms, now, limits) { this.figures.frames++; this.ladder.frame(ms, now, this.#stream?.shown(this.time).rung ?? 0, limits); }

  /** 'auto', or the rung of the ladder that alone is rendered, 1 the coarsest. */
  get rung() { return this.#pin === null ? 'auto' : this.#pin + 1; }
  set rung(x) { this.ladder.pinned = this.#pin = rungOf(x); this.redraw(CONTENT); }

  /** What is rendered of the ladder (`Stream.rungs`); null for files without one. */
  get rungState() { return this.#stream?.rungs(this.time) ?? null; }

  #tellRung() {
    const detail = this.rungState, what = detail && Object.values(detail).slice(0, -1).join();
    if (what !== (this.#told.rung ?? null)) this.emit('rungchange', detail ?? {});
    this.#told.rung = what;
  }

  #tellTime() {
    const { time } = this;
    if (!this.backend?.shown || this.#told.time === time) return;
    this.#told.time = time;
    this.emit('timeupdate', { time });
  }

  #tell(now) {
    this.#tellTime();
    if (this.#told.camera) {
      this.#told.camera = false;
      this.emit('camerachange', { camera: this.camera.toJSON() });
    }
    if (now - this.#bufferAt > BUFFER_EVERY) {
      this.#bufferAt = now;
      this.buffered = this.still ? [] : this.#stream.buffered(BUFFER_POINTS);
      this.#tellRung();
      this.emit('progress', { ready: this.#stream.ready(this.clock) });
    }
  }

  // What others may call.

  /** A PNG of the image, as shown but always at full resolution; its `time` is the second that it shows. */
  async screenshot() {
    if (!this.file || !this.backend) {
      throw new SceneError('No image has been rendered yet', 'screenshot', 'Wait until the scene has loaded.');
    }
    this.#paint(1, { force: true });
    await this.backend.settled();
    // Meanwhile another image may have been rendered, at another resolution.
    this.#paint(1, { force: true });
    const { time } = this, { width, height, data } = await this.backend.readPixels();
    const canvas = new OffscreenCanvas(width, height);
    canvas.getContext('2d').putImageData(new ImageData(data, width, height), 0, 0);
    this.redraw();
    return Object.assign(await canvas.convertToBlob({ type: 'image/png' }), { time });
  }

  /** Resolves when the clock's time is complete and rendered. */
  async settled() {
    await this.#stream?.settled(this.clock);
    await new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)));
    await this.backend?.settled();
  }

  link() { return linkText({ camera: this.camera, time: this.target, channel: this.channel, playing: this.playing }); }

  get statistics() {
    const { width, height } = this.canvas;
    const { fps, frameMs } = this.#pace;
    return {
      ...this.figures, fps, frameMs, atRest: performance.now() - this.#drawnAt > 1000, ...this.backend?.stats,
      backend: this.backend?.name ?? null, width, height, scale: this.scale,
      gaussians: this.meta?.gaussians ?? 0, ready: this.ready(this.clock),
      ladder: this.rungState, megabits: (this.file?.rate(performance.now()) ?? 0) / 1e6,
      leftOut: this.#stream?.left ?? 0, bytesRead: this.file?.bytesRead ?? 0, bytesTotal: this.file?.bytesTotal ?? 0,
    };
  }

  /** While a headset draws, the page does not. */
  set immersed(on) { this.#xr = on; this.#told.size = null; this.redraw(); this.emit('immersed', { on }); }
  advance(dt) {
    this.#last = performance.now();
    if (this.#stream) this.#moveTime(dt);
    this.#hear();
    this.#tellTime();
  }

  destroy() {
    cancelAnimationFrame(this.#frame);
    this.#run++;
    this.#abort?.abort();
    document.removeEventListener('visibilitychange', this.sleeps);
    this.resizes.disconnect();
    this.sight.disconnect();
    this.sound.drop();
    this.#stream?.destroy();
    this.backend?.destroy();
    this.file?.close();
    this.file = null;
  }
}

// <splat-4d src="scene.s4d">: the player as an element. Attributes and events: docs/player.md.

import { CHANNELS, Player } from './player.js';
import { CSS } from './style.js';
import { Interface } from './ui.js';
import { h } from './dom.js';
import { readLink, vector } from './camera.js';

const OBSERVED = ['src', 'controls', 'time', 'speed', 'loop', 'backend', 'channel', 'background', 'camera', 'poster',
  'theme', 'resolution', 'heading', 'muted', 'rung'];
/** Events of the player that the element shows to its page. */
const EVENTS = ['load', 'timeupdate', 'play', 'pause', 'ended', 'error', 'camerachange', 'channelchange', 'labelschange',
  'ratechange', 'volumechange', 'rungchange'];

/** Hosts of pages that are being written. */
const LOCAL = ['', 'localhost', '127.0.0.1', '[::1]'];

let sheet;

/** '#rrggbb' or '#rgb' as three numbers in 0..1; null for 'scene' and for what is no colour. */
function colour(text) {
  const hex = /^#([0-9a-f]{3}|[0-9a-f]{6})$/i.exec((text ?? '').trim())?.[1];
  const digits = hex?.match(hex.length === 3 ? /./g : /../g);
  return digits?.map(x => parseInt(x + (x.length === 1 ? x : ''), 16) / 255) ?? null;
}

/** 'x,y,z tx,ty,tz [fov]': where the camera is, its target, degrees. */
function place(text) {
  const n = (text ?? '').split(/[\s,]+/).filter(Boolean).map(Number);
  if (![6, 7].includes(n.length) || n.some(x => !isFinite(x))) return undefined;
  return { position: n.slice(0, 3), target: n.slice(3, 6), fov: n[6] };
}

export class Splat4D extends HTMLElement {
  static observedAttributes = OBSERVED;
  #player = null;
  #ui = null;
  #training = null;
  #scene = null;
  #queued = false;

  connectedCallback() {
    if (this.#player) return;
    const shadow = this.shadowRoot ?? this.attachShadow({ mode: 'open' });
    if (!sheet) { sheet = new CSSStyleSheet(); sheet.replaceSync(CSS); }
    shadow.adoptedStyleSheets = [sheet];
    const stage = h('div', { class: 'stage', tabindex: 0, role: 'application', 'aria-roledescription': '3D viewer',
      'aria-label': 'Scene' });
    const root = h('div', { class: 'root', part: 'root' }, stage);
    shadow.replaceChildren(root);
    const player = this.#player = new Player(stage);
    const ui = this.#ui = new Interface(root, player, {
      page: this.hasAttribute('page'), embed: this.hasAttribute('embed'),
      open: file => { this.scene = file; }, retry: () => this.#load(),
    });
    for (const name of EVENTS) {
      player.addEventListener(name, e => this.dispatchEvent(new CustomEvent(name, { detail: e.detail })));
    }
    // Permanent faults of the file are errors for the page as well; temporary ones are not.
    player.addEventListener('trouble', ({ detail: { error, lasting } }) => {
      const { what, where, remedy } = error;
      if (lasting) this.dispatchEvent(new CustomEvent('error', { detail: { error, what, where, remedy } }));
    });
    player.addEventListener('scene', () => {
      ui.setTitle(this.getAttribute('heading') ?? player.meta.title ?? this.#scene?.name);
    });
    for (const name of OBSERVED) if (name !== 'src') this.#apply(name, this.getAttribute(name));
    // What few pages need is fetched when it is needed.
    ui.xr = mode => import('./xr.js').then(m => m.enter(player, mode)).catch(error => ui.toast(error.message));
    for (const [mode, tool] of [['immersive-vr', ui.xrTool], ['immersive-ar', ui.arTool]]) {
      navigator.xr?.isSessionSupported(mode).then(yes => { tool.hidden = !yes; }, () => {});
    }
    if (this.hasAttribute('page')) {
      addEventListener('hashchange', this.#hash);
      // While the page has not chosen a scene. A failure is reported when there is a scene to render.
      player.prepare().catch(() => {});
    }
    this.#load();
  }

  disconnectedCallback() {
    // An element that is only moved about the page is connected again at once.
    queueMicrotask(() => {
      if (this.isConnected || !this.#player) return;
      removeEventListener('hashchange', this.#hash);
      this.#training?.close();
      this.#ui.destroy();
      this.#player.destroy();
      this.#player = this.#ui = this.#training = null;
    });
  }

  attributeChangedCallback(name, before, value) {
    if (!this.#player || before === value) return;
    if (name !== 'src') return this.#apply(name, value);
    this.#scene = null;
    this.#load();
  }

  #apply(name, value) {
    const p = this.#player, ui = this.#ui, set = {
      controls: () => { ui.hiddenControls = value === 'none' || value === 'false'; ui.refresh(); },
      time: () => value !== null && p.file && p.seek(+value),
      speed: () => { if (value !== null) p.speed = +value; },
      loop: () => { p.loop = value !== 'false'; ui.refresh(); },
      backend: () => p.useBackend(['webgpu', 'webgl2'].includes(value) ? value : 'auto'),
      channel: () => CHANNELS.includes(value) && p.setChannel(value),
      background: () => { p.background = colour(value); p.redraw(); },
      camera: () => { const c = place(value); if (c && p.file) p.setCamera(c); },
      poster: () => value && ui.setPoster(new URL(value, document.baseURI).href),
      theme: () => value && ui.setTheme(['light', 'dark'].includes(value) ? value : 'auto'),
      resolution: () => value && ui.setResolution(value === 'auto' ? value : +value),
      rung: () => { p.rung = value; ui.refresh(); },
      muted: () => { p.sound.muted = value !== null; },
      heading: () => ui.setTitle(value ?? p.meta?.title),
    };
    set[name]?.();
  }

  /** Several attributes set together open the scene once. */
  #load() {
    if (this.#queued) return;
    this.#queued = true;
    queueMicrotask(() => {
      this.#queued = false;
      if (this.#player) this.#open();
    });
  }

  async #open() {
    const p = this.#player, ui = this.#ui;
    const src = this.getAttribute('src');
    const source = this.#scene ?? (src ? new URL(src, document.baseURI).href : null);
    if (!source) {
      // A page that sets the scene later must not flash a notice; an element whose markup is still being read is not
      // empty either.
      if (LOCAL.includes(location.hostname) && !this.hasAttribute('page')) ui.showNote('No scene: set the attribute src or the property scene.');
      return;
    }
    const poster = this.getAttribute('poster');
    if (poster) ui.setPoster(new URL(poster, document.baseURI).href);
    await p.load(source, { start: this.#start() });
  }

  /** Labels as colours, or one label alone: docs/player.md. */
  setLabels(show) { this.#player?.setLabels(show); }

  /** How a scene begins: the attributes say, and a page's address states more. */
  #start() {
    const time = this.getAttribute('time');
    return {
      camera: place(this.getAttribute('camera')), time: time === null ? undefined : +time,
      channel: this.getAttribute('channel') ?? undefined, playing: this.hasAttribute('autoplay'),
      ...(this.hasAttribute('page') ? readLink(location.hash) : {}),
    };
  }

  #hash = () => {
    const link = readLink(location.hash), p = this.#player;
    if (!p?.file) return;
    if (link.camera) p.setCamera(link.camera);
    if (link.time !== undefined) p.seek(link.time);
    if (link.channel) p.setChannel(link.channel);
    if (link.playing !== undefined) link.playing ? p.play() : p.pause();
  };

  // For the page's own scripts.

  /** A File, Blob, ArrayBuffer or address to show in place of `src`. */
  get scene() { return this.#scene; }
  set scene(value) { this.#scene = value; this.#load(); }
  get player() { return this.#player; }
  get face() { return this.#ui; }
  get paused() { return !this.#player?.playing; }
  get currentTime() { return this.#player?.time ?? 0; }
  set currentTime(t) { this.seek(t); }
  get seeking() { return this.#player?.seeking ?? false; }
  get muted() { return this.#player?.sound.muted ?? this.hasAttribute('muted'); }
  set muted(on) { if (this.#player) this.#player.sound.muted = on; else this.toggleAttribute('muted', !!on); }
  /** 'auto', or the rung of the ladder that alone is rendered, 1 the coarsest. */
  get rung() { return this.#player?.rung ?? this.getAttribute('rung') ?? 'auto'; }
  set rung(x) { if (this.#player) this.#player.rung = x; else this.setAttribute('rung', x); }
  /** {rung, chosen, limit, rungs, reason, rate, leftOut}; null without a ladder. */
  get ladder() { return this.#player?.rungState ?? null; }
  get volume() { return this.#player?.sound.volume ?? 1; }
  set volume(x) { if (this.#player) this.#player.sound.volume = x; }
  get duration() { return this.#player?.duration ?? 0; }
  get statistics() { return this.#player?.statistics; }
  /** {position, quat (world from camera, wxyz), target, fov degrees}; setting takes any of them. */
  get camera() { return this.#player?.camera.toJSON(); }
  set camera(value) {
    const given = typeof value === 'string' ? place(value) : value;
    if (given) this.#player?.setCamera({ ...given, position: vector(given.position) ?? undefined });
  }
  play() { this.#player?.play(); }
  pause() { this.#player?.pause(); }
  seek(t) { this.#player?.seek(+t); }
  step(frames = 1) { this.#player?.step(frames); }
  async screenshot() { return this.#player.screenshot(); }
  async settled() { return this.#player.settled(); }
  /** The deep link's part behind '#'. */
  get link() { return this.#player?.link(); }

  /** Opens the file dialog if there is nothing to show. */
  invite() { this.#ui.showEmpty(); }

  /** Follows a training run: {events, src, metrics} addresses; `version` of the scene that is there already. */
  async follow(run) {
    const { Training } = await import('./live.js');
    this.#training?.close();
    this.#training = new Training(this.#ui, { ...run,
      reload: address => this.#player?.load(address, { keep: true, start: this.#start() }) });
  }
}

if (!customElements.get('splat-4d')) customElements.define('splat-4d', Splat4D);

// The player's face: bar, panels, messages and keys over one Player.

import { SPEED_RANGE } from './constants.js';
import { CHANNELS } from './player.js';
import { CHANNEL_NAMES, SPEEDS, cameraPanel, figuresCard, helpPage, megabits, readPath, viewPanel } from './panels.js';
import { button, bytes, choice, clock, h, pick, retool, save, segments, shown, tool } from './dom.js';
import { clamp } from './camera.js';
import { icon } from './icons.js';

/** Quiet seconds after which the controls hide: soon while something plays, later where nothing does. */
const IDLE_PLAYING = 2.5;
const IDLE_STILL = 8;
/** Milliseconds that a short notice stays. */
const TOAST = 1800;
/** Milliseconds that the hint stays that a scene can be turned, and where a page remembers that it was shown. */
const HINT = 6000, HINTED = 'splat4d-hinted';
/** A loading that is shorter shows no sign of itself, ms. */
const QUICK = 250;
/** Milliseconds between two readings of the figures. */
const FIGURES_EVERY = 500;
/** An arrow key seeks a second, or a tenth of a shorter clip. */
const SEEK = 1;

export class Interface {
  theme = 'auto';
  figuresOn = false;
  #timers = {};
  #panel = null;
  #poster = null;
  #active = 0;

  /** `page`: fills a page, so that keys work everywhere and files may be dropped. `embed`: only the necessary. */
  constructor(root, player, { page = false, embed = false, open, retry } = {}) {
    Object.assign(this, { root, player, page, embed, openFile: open, retry });
    this.stage = player.stage;
    this.#build();
    this.#listen();
    this.#recall();
    this.wake();
    this.refresh();
  }

  #build() {
    const p = this.player;
    this.play = tool('play', 'Play', () => p.toggle());
    this.back = tool('back', 'One frame back', () => p.step(-1), { class: 'tool wide' });
    this.next = tool('next', 'One frame forward', () => p.step(1), { class: 'tool wide' });
    this.loopTool = tool('loop', 'Loop', () => this.setLoop(!p.loop), { class: 'tool wide', 'aria-pressed': 'true' });
    this.now = h('b', {}, '0:00.00');
    this.end = h('span', { class: 'of' }, ' / 0:00.00');
    this.timeLabel = h('div', { class: 'time', 'aria-hidden': 'true' }, this.now, this.end);
    this.speed = choice('Speed', SPEEDS.map(s => [s, `${s}×`]), s => { p.speed = +s; }, { class: 'speed' });
    this.channel = segments('Channel', CHANNELS.map(c => [c, CHANNEL_NAMES[c]]), c => p.setChannel(c),
      { class: 'roomy' });
    const opener = (name, label, id) => tool(name, label, () => this.open(this.#panel === id ? null : id),
      { 'aria-expanded': 'false', 'aria-haspopup': 'dialog' });
    this.openers = {
      cameras: opener('camera', 'Cameras and paths', 'cameras'),
      view: opener('view', 'View and settings', 'view'),
    };
    this.soundTool = tool('sound', 'Mute', () => this.toggleSound(), { hidden: true });
    this.full = tool('full', 'Full screen', () => this.fullscreen());
    this.xrTool = tool('headset', 'View in VR', () => this.xr?.('immersive-vr'), { hidden: true });
    this.arTool = tool('room', 'View in AR; tap the floor to place the scene', () => this.xr?.('immersive-ar'), { hidden: true });
    this.helpTool = tool('help', 'Keys and gestures', () => this.toggleHelp(), { class: 'tool wide' });
    this.#scrub();
    const spare = this.embed ? [] : [this.channel, this.openers.cameras, this.openers.view, this.helpTool];
    const steps = this.embed ? [] : [this.back, this.next];
    this.bar = h('div', { class: 'card bar', role: 'toolbar', 'aria-label': 'Playback' }, this.scrub,
      h('div', { class: 'row' }, this.play, ...steps, this.timeLabel, h('div', { class: 'space' }),
        this.embed ? null : this.loopTool, this.embed ? null : this.speed, ...spare, this.soundTool, this.xrTool, this.arTool, this.full));
    // Without space, an element of a user's page keeps what plays.
    for (const item of [this.back, this.next, this.loopTool, this.speed, ...spare]) item.classList.add('spare');
    this.root.classList.toggle('page', this.page);
    this.panels = { cameras: cameraPanel(this), view: viewPanel(this) };
    this.dock = h('div', { class: 'dock' }, this.panels.cameras, this.panels.view, this.bar);
    this.title = h('div', { class: 'card title', hidden: true });
    this.scale = h('div', { class: 'card depth', hidden: true, role: 'img' }, h('span'), h('i'), h('span'));
    this.figures = figuresCard(p);
    this.left = h('div', { class: 'left' }, this.title, this.scale, this.figures);
    this.help = helpPage(() => this.toggleHelp(false));
    this.notice = h('div', { class: 'centre' });
    this.ring = h('div', { class: 'card load', role: 'status', hidden: true },
      h('div', { class: 'ring' }), h('span'));
    this.toastBox = h('div', { class: 'card toast', role: 'status', 'aria-live': 'polite' });
    this.hint = h('div', { class: 'card hint', role: 'status' });
    this.posterBox = h('img', { class: 'poster', alt: '' });
    this.face = h('div', { class: 'ui' }, h('div', { class: 'top' }, this.left), this.ring, this.hint, this.dock,
      this.notice, this.help, this.toastBox);
    this.root.append(this.posterBox, this.face);
  }

  #scrub() {
    this.there = [];
    this.done = h('i', { class: 'done' });
    this.future = h('i', { class: 'future', title: 'Predicted' });
    this.rail = h('div', { class: 'rail' }, this.done, this.future);
    this.knob = h('div', { class: 'knob' });
    this.tip = h('div', { class: 'tip', 'aria-hidden': 'true' });
    const at = e => {
      const box = this.rail.getBoundingClientRect();
      return clamp((e.clientX - box.left) / Math.max(box.width, 1), 0, 1);
    };
    const time = u => this.player.first + u * this.player.duration;
    let resume = false;
    this.scrub = h('div', { class: 'scrub', role: 'slider', tabindex: 0, 'aria-label': 'Time',
      'aria-valuemin': 0, 'aria-valuemax': 0, 'aria-valuenow': 0,
      onpointerdown: e => {
        this.scrub.setPointerCapture(e.pointerId);
        resume = this.player.playing;
        this.player.pause();
        this.#userSeek(time(at(e)));
      },
      onpointermove: e => {
        const u = at(e);
        this.tip.style.left = `${100 * u}%`;
        this.tip.textContent = clock(time(u) - this.player.first);
        if (this.scrub.hasPointerCapture(e.pointerId)) this.#userSeek(time(u));
      },
      onlostpointercapture: () => { if (resume) this.player.play(); resume = false; },
    }, this.rail, this.knob, this.tip);
  }

  #userSeek(time) {
    if (this.player.film && !this.player.film.frozen) this.player.stopFilm();
    this.player.seek(time);
    this.#showTime();
  }

  #listen() {
    const p = this.player;
    const on = (name, f) => p.addEventListener(name, f);
    on('timeupdate', () => this.#showTime());
    for (const name of ['play', 'pause', 'ratechange', 'channelchange', 'labelschange', 'film', 'mode', 'backend', 'volumechange']) {
      on(name, () => this.refresh());
    }
    on('scene', () => {
      // The server has more data of the capture's cameras than the file.
      if (this.capture?.cameras) p.meta.cameras = this.capture.cameras;
      // The background of the scene, also where a poster leaves it free and before the first image.
      const back = p.background ?? p.meta.background;
      this.stage.style.background = `rgb(${back.map(x => Math.round(255 * clamp(x, 0, 1)))})`;
    });
    on('scene', () => { this.notice.replaceChildren(); this.refresh(); this.#showTime(); });
    on('progress', () => this.#progress());
    on('waiting', () => this.#progress());
    on('statechange', () => this.#stateChanged());
    on('error', e => this.#error(e.detail.error));
    on('leftout', e => this.quiet || this.toast(
      `Too large for this device: ${e.detail.gaussians.toLocaleString('en-GB')} Gaussians of least importance are left out`, 3 * TOAST));
    on('rungchange', e => this.#rungChanged(e.detail));
    on('trouble', e => this.quiet || this.toast(e.detail.error.what ?? e.detail.error.message, 3 * TOAST));
    on('poster', e => this.setPoster(e.detail.blob));
    on('viewed', e => { this.toast(`Camera ${e.detail.number + 1} · ${e.detail.name ?? ''}`); this.refresh(); });
    on('camerachange', () => this.#showScale());
    on('camerachange', () => { if (p.viewed == null) this.panels.cameras.refresh(); });
    // A finger that taps brings the controls back and sends them away; a mouse only has to move.
    let tap = null;
    this.root.addEventListener('pointermove', e => { if (e.pointerType !== 'touch' || e.buttons) this.wake(); });
    this.root.addEventListener('pointerdown', e => {
      tap = e.pointerType === 'touch' && this.stage.contains(e.target)
        ? { x: e.clientX, y: e.clientY, idle: this.root.classList.contains('idle') } : null;
      this.wake();
      this.#endHint();
      if (this.stage.contains(e.target)) this.open(null, false);
    });
    this.root.addEventListener('pointerup', e => {
      if (tap && !tap.idle && Math.hypot(e.clientX - tap.x, e.clientY - tap.y) < 8 && p.playing) this.sleep();
    });
    this.root.addEventListener('focusin', () => this.wake());
    // Browsers allow sound once the page was touched; the sound's own control is a touch too.
    const touched = e => { if (!this.soundTool.contains(e.composedPath()[0])) p.sound.touched(); };
    this.root.addEventListener('pointerup', touched);
    this.root.addEventListener('keydown', touched);
    const keys = this.page ? window : this.root;
    this.#on(keys, 'keydown', e => this.#key(e));
    this.#on(keys, 'keyup', e => { p.controls.key(e.code, false); this.#turnKey(e, false); });
    this.#on(window, 'blur', () => p.controls.release());
    this.#on(document, 'fullscreenchange', () => this.refresh());
    p.controls.wheelWanted = e => this.page || e.ctrlKey || this.root.contains(this.focused());
    if (this.page) this.#drops();
    this.#timers.figures = setInterval(() => this.figuresOn && this.figures.refresh(), FIGURES_EVERY);
  }

  #ends = [];
  #on(target, name, f) {
    target.addEventListener(name, f);
    this.#ends.push(() => target.removeEventListener(name, f));
  }

  destroy() {
    this.#ends.forEach(end => end());
    Object.values(this.#timers).forEach(t => { clearTimeout(t); clearInterval(t); });
    this.setPoster(null);
    this.face.remove();
    this.posterBox.remove();
  }

  focused() { return this.root.getRootNode().activeElement; }

  // What is shown.

  refresh() {
    const p = this.player, moving = p.playing || (p.film && !p.film.frozen);
    retool(this.play, moving ? 'pause' : 'play', moving ? 'Pause' : 'Play');
    for (const item of [this.play, this.back, this.next, this.loopTool, this.speed]) item.disabled = p.still || !p.file;
    const { there, audible, blocked } = p.sound;
    this.soundTool.hidden = !there;
    retool(this.soundTool, audible ? 'sound' : 'silent', blocked ? 'Sound on (the browser waits for a click)' : audible ? 'Mute' : 'Sound on');
    this.scrub.hidden = p.still;
    this.timeLabel.hidden = p.still;
    for (const item of [this.play, this.back, this.next, this.loopTool, this.speed]) item.hidden = !!p.file && p.still;
    this.loopTool.setAttribute('aria-pressed', String(p.loop));
    this.speed.set(p.speed, `${+p.speed.toFixed(2)}×`);
    this.channel.set(p.channel);
    this.#showScale();
    const on = !!this.root.getRootNode().fullscreenElement;
    retool(this.full, on ? 'small' : 'full', on ? 'Leave full screen' : 'Full screen');
    this.full.hidden = !document.fullscreenEnabled;
    this.dock.hidden = (this.hiddenControls ?? false) || ['empty', 'error'].includes(p.state);
    for (const panel of Object.values(this.panels)) panel.refresh();
    if (!this.#panel) this.wake();
  }

  /** Reports that less than the whole is rendered, and why; not that it is more again. */
  #rungChanged({ limit, chosen, rungs, reason, rate }) {
    const least = Math.min(limit ?? Infinity, chosen ?? Infinity);
    if (least < this.#least && ['device', 'connection'].includes(reason) && !this.quiet) {
      this.toast(`${reason === 'device' ? 'Slow device' : 'Slow connection'}: bit rate ${least} of ${rungs}, ${megabits(1e6 * rate)}`, 2 * TOAST);
    }
    this.#least = least;
    this.panels.view.refresh();
  }
  #least = 0;

  /** Distances that the depth view's brightness represents. */
  #showScale() {
    const p = this.player;
    this.scale.hidden = p.channel !== 'depth' || !p.file;
    if (this.scale.hidden) return;
    const { unit } = p.meta, [near, far] = p.depthRange().map(z => `${(z * (unit ?? 1)).toPrecision(2)}${unit ? ' m' : ''}`);
    this.scale.firstChild.textContent = near;
    this.scale.lastChild.textContent = unit ? far : `${far} units`;
    this.scale.setAttribute('aria-label', `Depth from ${near} (bright) to ${far} (dark)`);
  }

  #showTime() {
    // The clock states what is shown; the slider is where it was put.
    const p = this.player, at = p.target - p.first;
    const u = p.duration > 0 ? clamp(at / p.duration, 0, 1) : 0;
    this.now.textContent = clock(p.time - p.first, p.duration);
    this.end.textContent = ` / ${clock(p.duration)}`;
    this.done.style.width = this.knob.style.left = `${100 * u}%`;
    const from = p.meta?.predicted, predicted = Number.isFinite(from) && p.duration > 0;
    this.future.hidden = !predicted;
    if (predicted) this.future.style.left = `${100 * clamp((from - p.first) / p.duration, 0, 1)}%`;
    const s = this.scrub;
    s.setAttribute('aria-valuemax', p.duration.toFixed(2));
    s.setAttribute('aria-valuenow', at.toFixed(2));
    s.setAttribute('aria-valuetext', `${at.toFixed(2)} of ${p.duration.toFixed(2)} seconds${predicted && p.target >= from ? ', predicted' : ''}`);
  }

  #progress() {
    const p = this.player, spans = p.buffered;
    while (this.there.length < spans.length) {
      const bar = h('i', { class: 'there' });
      this.there.push(bar);
      this.rail.prepend(bar);
    }
    while (this.there.length > spans.length) this.there.pop().remove();
    spans.forEach(([a, b], i) => {
      this.there[i].style.left = `${100 * a}%`;
      this.there[i].style.width = `${100 * (b - a)}%`;
    });
    const loading = p.state === 'loading', busy = loading || p.waiting;
    if (busy && !this.busySince) this.busySince = performance.now();
    if (!busy) this.busySince = 0;
    this.ring.hidden = !busy || performance.now() - this.busySince < QUICK;
    const file = p.file;
    const text = file ? `${loading ? 'Loading' : 'Waiting'} · ${bytes(file.bytesRead)}` : 'Opening the scene';
    if (!this.ring.hidden && this.ring.lastChild.textContent !== text) this.ring.lastChild.textContent = text;
  }

  #stateChanged() {
    const { state } = this.player;
    this.root.dataset.state = state;
    this.root.setAttribute('aria-busy', String(state === 'loading'));
    if (state === 'loading') {
      this.notice.replaceChildren();
      this.busySince ||= performance.now();
      setTimeout(() => this.#progress(), QUICK + 20);
    }
    if (state === 'ready') {
      this.setPoster(null);
      this.#showHint();
    }
    this.#progress();
    this.refresh();
  }

  /** Shows an image until the first frame: an address or a Blob; null takes it away. */
  setPoster(what) {
    if (this.#poster) URL.revokeObjectURL(this.#poster);
    this.#poster = what instanceof Blob ? URL.createObjectURL(what) : null;
    const src = this.#poster ?? what;
    if (src && this.player.state !== 'ready') {
      this.posterBox.src = src;
      this.posterBox.classList.add('on');
    } else this.posterBox.classList.remove('on');
  }

  setTitle(given) {
    const text = shown(given || '');
    this.title.textContent = text;
    this.title.hidden = !text || this.embed;
    this.stage.setAttribute('aria-label', text ? `Scene: ${text}` : 'Scene');
  }

  #error(error) {
    this.open(null, false);
    this.setPoster(null);
    this.notice.replaceChildren(h('section', { class: 'card notice bad', role: 'alert' },
      h('h2', {}, icon('warning'), h('span', {}, error.what)),
      error.where ? h('code', {}, String(error.where)) : null,
      error.remedy ? h('p', {}, error.remedy) : null,
      h('div', { class: 'wrap' },
        this.retry ? button('Try again', () => this.retry(), { class: 'main' }) : null,
        this.page ? button('Open another file', () => this.pickFile(), {}, 'open') : null)));
  }

  /** A line in the middle, until there is a scene. */
  showNote(text) {
    this.notice.replaceChildren(h('p', { class: 'note' }, text));
    this.refresh();
  }

  /** The page without a scene. */
  showEmpty() {
    this.notice.replaceChildren(h('section', { class: 'card notice drop', 'aria-label': 'Open a scene' },
      h('div', { class: 'mark' }),
      h('h2', {}, 'Open a scene'),
      h('p', { class: 'note' }, 'Drop a .s4d file here. It is not uploaded.'),
      button('Choose a file', () => this.pickFile(), { class: 'main' })));
    this.refresh();
  }

  toast(text, ms = TOAST) {
    this.toastBox.textContent = text;
    this.toastBox.classList.add('on');
    clearTimeout(this.#timers.toast);
    this.#timers.toast = setTimeout(() => this.toastBox.classList.remove('on'), ms);
  }

  /** Once: nothing else shows that the scene is more than a video. */
  #showHint() {
    if (this.embed || this.hiddenControls || this.player.film || known(this.page)) return;
    const touch = matchMedia('(pointer: coarse)').matches;
    this.hint.textContent = touch ? 'Drag to turn · pinch to zoom' : 'Drag to turn · scroll to zoom';
    this.hint.classList.add('on');
    this.#timers.hint = setTimeout(() => this.#endHint(), HINT);
  }

  #endHint() {
    clearTimeout(this.#timers.hint);
    this.hint.classList.remove('on');
  }

  /** Opens a panel by name, or closes what is open. */
  open(name, refocus = true) {
    const before = this.#panel;
    if (name && this.editing?.open) this.editing.toggle(false);
    this.#panel = name;
    for (const key of Object.keys(this.panels)) {
      this.panels[key].hidden = key !== name;
      this.openers[key].setAttribute('aria-expanded', String(key === name));
    }
    if (name) {
      this.panels[name].refresh();
      this.panels[name].querySelector('button').focus({ preventScroll: true });
    } else if (before && refocus) this.openers[before].focus({ preventScroll: true });
  }

  toggleHelp(on = this.help.hidden) {
    if (on === !this.help.hidden) return;
    this.help.hidden = !on;
    this.face.querySelector('.dock').inert = on;
    if (on) { this.before = this.focused(); this.help.querySelector('button').focus({ preventScroll: true }); }
    else (this.before ?? this.stage).focus?.({ preventScroll: true });
  }

  // Quiet controls.

  wake() {
    this.root.classList.remove('idle');
    clearTimeout(this.#timers.idle);
    const p = this.player;
    this.#timers.idle = setTimeout(() => this.sleep(), 1000 * (p.playing || p.film ? IDLE_PLAYING : IDLE_STILL));
  }

  sleep() {
    const p = this.player;
    const used = this.#panel || this.editing?.open || !this.help.hidden || p.state !== 'ready' || this.bar.matches(':hover')
      || this.bar.querySelector(':focus-visible');
    if (used) return this.wake();
    this.root.classList.add('idle');
  }

  // User requests.

  setLoop(on) {
    this.player.loop = on;
    this.toast(on ? 'Loop' : 'Play once');
    this.refresh();
  }

  /** Sound on or off; where the browser waits for a gesture, this is one. */
  toggleSound() {
    const { sound } = this.player;
    if (!sound.there) return;
    if (sound.blocked) sound.touched();
    else sound.muted = !sound.muted;
    this.toast(sound.muted ? 'Muted' : 'Sound on');
  }

  setResolution(value) {
    this.player.resolution = value === 'auto' ? 'auto' : clamp(+value || 1, 0.1, 1);
    this.player.redraw();
    this.#remember();
    this.refresh();
  }

  setTheme(theme) {
    this.theme = theme;
    if (theme === 'auto') delete this.root.dataset.theme;
    else this.root.dataset.theme = theme;
    this.#remember();
    this.refresh();
    this.root.dispatchEvent(new CustomEvent('themechange'));
  }

  get dark() {
    return this.theme === 'auto' ? !matchMedia('(prefers-color-scheme: light)').matches : this.theme === 'dark';
  }

  setFigures(on) {
    this.figuresOn = on;
    this.figures.hidden = !on;
    if (on) this.figures.refresh();
    this.#remember();
    this.refresh();
  }

  fullscreen() {
    const host = this.root.getRootNode().host ?? this.root;
    if (document.fullscreenElement) document.exitFullscreen();
    else host.requestFullscreen?.().catch(() => this.toast('The browser does not allow full screen here'));
  }

  async screenshot() {
    try {
      const name = (this.title.textContent || 'scene').replace(/[^\w-]+/g, '-').toLowerCase();
      save(await this.player.screenshot(), `${name}-${this.player.time.toFixed(2)}s.png`);
      this.toast('Image saved');
    } catch (error) { this.toast(error.what ?? error.message, 2 * TOAST); }
  }

  async copyLink() {
    const link = `${location.href.split('#')[0]}#${this.player.link()}`;
    try {
      await navigator.clipboard.writeText(link);
      this.toast('Link copied');
    } catch {
      // Without a secure context or the permission, the address bar holds it for copying by hand.
      history.replaceState(null, '', link);
      this.toast('The link is in the address bar');
    }
  }

  pickFile() { pick('.s4d,.splat4d', file => this.openFile(file)); }

  addKey() {
    const p = this.player;
    if (!p.file) return;
    p.track.add(p.camera, p.still ? null : p.target);
    this.toast(`Key ${p.track.keys.length} added`);
    this.refresh();
  }

  goTo(key) {
    this.player.setCamera(key.camera, { glide: true });
    if (key.sceneTime !== null) this.player.seek(key.sceneTime);
  }

  playPath() {
    const p = this.player;
    if (p.film) p.stopFilm();
    else if (p.track.keys.length > 1) p.playFilm();
    else this.toast('A path needs two keys: move the camera and press K');
  }

  /** Cameras of the capture; fetched when first requested. */
  async #rigged() {
    const { Rig } = await import('./rig.js');
    return this.rig ??= new Rig(this, this.capture ?? {});
  }

  async showCameras(on = !this.rig?.shown) {
    if (!this.player.meta?.cameras?.length) return this.toast('The scene does not name the cameras of its capture');
    (await this.#rigged()).show(on);
    this.refresh();
  }

  async compare(on = !this.rig?.compared) {
    if (!this.capture?.photos) return this.toast('The images of the capture are not served here');
    (await this.#rigged()).compare(on);
    this.refresh();
  }

  bullet() {
    const p = this.player;
    if (p.film?.frozen) p.stopFilm();
    else p.playFilm({ frozen: true });
  }

  async importPath(file) {
    try {
      this.player.track = await readPath(file, this.player.camera);
      this.toast(`Path with ${this.player.track.keys.length} keys`);
    } catch (error) { this.toast(`${file.name}: ${error.message}`, 4 * TOAST); }
    this.refresh();
  }

  // Files dropped on the page.

  #drops() {
    this.#on(window, 'dragover', e => { e.preventDefault(); this.root.classList.add('over'); });
    this.#on(window, 'dragleave', e => { if (!e.relatedTarget) this.root.classList.remove('over'); });
    this.#on(window, 'drop', e => {
      e.preventDefault();
      this.root.classList.remove('over');
      const file = e.dataTransfer?.files[0];
      if (!file) return;
      if (/\.json$/i.test(file.name) && this.player.file) this.importPath(file);
      else this.openFile(file);
    });
  }

  // Settings that stay, of the page only: an element belongs to its host.

  #remember() {
    if (!this.page || this.recalling) return;
    const kept = { theme: this.theme, figures: this.figuresOn, resolution: this.player.resolution };
    try { localStorage.setItem('splat4d', JSON.stringify(kept)); } catch { /* Storage may be shut; nothing is lost. */ }
  }

  #recall() {
    if (!this.page) return;
    this.recalling = true;
    try {
      const kept = JSON.parse(localStorage.getItem('splat4d')) ?? {};
      if (['auto', 'light', 'dark'].includes(kept.theme)) this.setTheme(kept.theme);
      if (kept.figures) this.setFigures(true);
      if (kept.resolution) this.setResolution(kept.resolution);
    } catch { /* As above. */ }
    this.recalling = false;
  }

  // Keys.

  #turnKey(e, down) {
    const way = e.key.match(/^Arrow(Left|Right|Up|Down)$/)?.[1];
    if (!way) return false;
    // Releasing shift first must not leave the turn on.
    if (down && !e.shiftKey) return false;
    return this.player.controls.key(`Turn${way}`, down);
  }

  #key(e) {
    const at = e.composedPath()[0];
    if (e.key === 'Escape') {
      if (!this.help.hidden) return this.toggleHelp(false);
      if (!this.#panel && this.editing?.escape()) return;
      if (this.#panel) return this.open(null);
      return this.player.film && this.player.stopFilm();
    }
    if (e.ctrlKey || e.metaKey || e.altKey || e.defaultPrevented || takes(at, e.key)) return;
    if (this.page && at instanceof Element && at.closest?.('a, textarea, [contenteditable]')) return;
    this.wake();
    const p = this.player;
    if (at === this.scrub && !e.shiftKey && this.#scrubKey(e.key)) return e.preventDefault();
    if (p.file && (this.#turnKey(e, true) || p.controls.key(e.code, true))) return e.preventDefault();
    const act = this.#actions()[e.key.length === 1 ? e.key.toLowerCase() : e.key];
    if (act && (p.file || 'h?tf'.includes(e.key))) { act(); e.preventDefault(); }
    else if (p.file && /^[1-9]$/.test(e.key)) p.view(+e.key - 1);
  }

  #scrubKey(key) {
    const p = this.player, steps = { PageDown: -1, PageUp: 1 };
    if (!(key in steps)) return false;
    this.#userSeek(p.target + steps[key] * p.duration / 10);
    return true;
  }

  #actions() {
    const p = this.player;
    const seek = way => this.#userSeek(p.target + way * Math.min(SEEK, p.duration / 10));
    const faster = way => {
      const list = way > 0 ? SPEEDS : [...SPEEDS].reverse();
      p.speed = list.find(s => (s - p.speed) * way > 1e-6) ?? clamp(p.speed, ...SPEED_RANGE);
      this.toast(`Speed ${p.speed}×`);
    };
    return {
      ' ': () => (p.film && !p.film.frozen ? p.stopFilm() : p.toggle()),
      ArrowLeft: () => seek(-1), ArrowRight: () => seek(1),
      ArrowUp: () => p.controls.zoom(0.9), ArrowDown: () => p.controls.zoom(1 / 0.9),
      Home: () => this.#userSeek(p.first), End: () => this.#userSeek(p.last),
      ',': () => p.step(-1), '.': () => p.step(1), '[': () => faster(-1), ']': () => faster(1),
      l: () => this.setLoop(!p.loop),
      c: () => {
        p.setChannel(CHANNELS[(CHANNELS.indexOf(p.channel) + 1) % CHANNELS.length]);
        this.toast(CHANNEL_NAMES[p.channel]);
      },
      n: () => p.view((p.viewed ?? -1) + 1), r: () => p.reset(),
      m: () => {
        p.setMode(p.controls.mode === 'orbit' ? 'fly' : 'orbit');
        this.toast(p.controls.mode === 'orbit' ? 'Orbit' : 'Fly');
      },
      k: () => this.addKey(), p: () => this.playPath(), b: () => this.bullet(),
      f: () => this.fullscreen(), i: () => this.setFigures(!this.figuresOn), g: () => this.screenshot(),
      u: () => this.toggleSound(), x: () => this.editing?.toggle(),
      v: () => this.showCameras(), z: () => this.compare(),
      t: () => this.setTheme(this.dark ? 'light' : 'dark'), h: () => this.toggleHelp(), '?': () => this.toggleHelp(),
    };
  }
}

let hinted = false;
/** Whether the hint was shown before, on this page or, where the page is the player's own, an earlier one. Now it was. */
function known(page) {
  let before = hinted;
  hinted = true;
  if (page) try {
    before ||= !!localStorage.getItem(HINTED);
    localStorage.setItem(HINTED, '1');
  } catch { /* Storage may be shut; then it is shown once a page. */ }
  return before;
}

/** Whether a control needs this key for itself. */
function takes(node, key) {
  if (!(node instanceof Element)) return false;
  if (node.matches('select, textarea, input:not([type=radio], [type=checkbox])')) return true;
  const arrow = key.startsWith('Arrow');
  if (node.matches('input[type=radio]')) return arrow || key === ' ';
  return node.matches('button, input[type=checkbox], a') && (key === ' ' || key === 'Enter');
}

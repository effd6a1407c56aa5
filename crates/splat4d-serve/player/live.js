// A scene that is still being learned: the server's events, the curve of its quality, and the newest snapshot.

import { button, h, save } from './dom.js';
import { icon } from './icons.js';

/** Milliseconds before another try to reach the server, doubled up to the second. */
const RETRY = [500, 8000];
/** Snapshots within this time, ms, are one update. */
const TOGETHER = 30;
/** In place of the figures before the first step: a large capture is read for minutes. */
const FIRST = 'The capture is read and the first Gaussians are placed. The render appears with the first snapshot.';
/** Points of the curve that are kept; beyond it every second one is dropped. */
const CURVE_MAX = 2000;

/** Follows `events`; `handlers`: {step(data), snapshot(version), state('connecting' | 'live' | 'away')}. */
export class Feed {
  #wait = RETRY[0];
  #timer = 0;
  #source = null;

  constructor(url, handlers) {
    this.url = url;
    this.handlers = handlers;
    this.#connect();
  }

  #connect() {
    this.handlers.state('connecting');
    const source = this.#source = new EventSource(this.url);
    source.onopen = () => { this.#wait = RETRY[0]; this.handlers.state('live'); };
    source.onmessage = e => this.#message(e.data);
    source.onerror = () => {
      // A browser retries on its own only after some kinds of failure, so that it is done here after all of them.
      source.close();
      this.handlers.state('away');
      this.#timer = setTimeout(() => this.#connect(), this.#wait);
      this.#wait = Math.min(2 * this.#wait, RETRY[1]);
    };
  }

  #message(text) {
    let data;
    try { data = JSON.parse(text); } catch { return; }
    if (data?.kind === 'step') this.handlers.step(readStep(data));
    else if (data?.kind === 'snapshot') this.handlers.snapshot(data.version);
    else if (data?.kind) this.handlers.other?.(data);
  }

  close() {
    clearTimeout(this.#timer);
    this.#source?.close();
  }
}

/** A step as the server sends it, by either of its two sets of names. */
function readStep({ psnr, loss, gaussians, held_out: held, ...s }) {
  const [step, of, left] = [s.iteration ?? s.step, s.iterations ?? s.of, s.seconds_left ?? s.left_s].map(Number);
  return { step, of, left, psnr: +psnr, loss: +loss, gaussians, held: held == null ? NaN : +held };
}

/** Steps already taken: JSON (a list, or the server's {news}) or the CSV of a run. */
export function readMetrics(text) {
  const usable = rows => rows.filter(r => isFinite(r.step) && isFinite(r.psnr));
  if (/^\s*[[{]/.test(text)) {
    const value = JSON.parse(text);
    return usable((Array.isArray(value) ? value : value.news ?? []).map(readStep));
  }
  const [head, ...lines] = text.trim().split(/\r?\n/).map(line => line.split(','));
  const column = name => head.indexOf(name);
  const [step, psnr, loss] = [column('iteration'), column('psnr'), column('loss')];
  return usable(lines.map(line => ({ step: +line[step], psnr: +line[psnr], loss: +line[loss] })));
}

/** The card: what is being learned, how good it is, how long it will take. */
export class Training {
  #points = [];

  constructor(ui, { events, src, metrics, version, reload, control }) {
    Object.assign(this, { ui, control });
    // Pages of a version that was replaced fail on the way, and the next version follows at once.
    ui.quiet = true;
    this.dot = h('i', { class: 'dot' });
    this.state = h('span', {}, 'Connecting');
    this.left = h('small');
    this.figures = h('div', { class: 'figures' });
    this.canvas = h('canvas', { role: 'img', 'aria-label': 'Quality over steps' });
    const axis = name => h('small', { class: name });
    this.axes = { psnr: [axis('high psnr'), axis('low psnr')], loss: [axis('high loss'), axis('low loss')], step: [axis(), axis()] };
    this.psnrName = h('small', { class: 'psnr' });
    this.plot = h('div', { class: 'plot', hidden: true },
      h('div', { class: 'names' }, this.psnrName, h('small', { class: 'loss' }, 'Loss')),
      h('div', { class: 'area' }, this.canvas, ...this.axes.psnr, ...this.axes.loss),
      h('div', { class: 'names' }, this.axes.step[0], h('small', {}, 'steps'), this.axes.step[1]));
    this.pause = button('Pause', () => this.#ask(this.at === 'paused' ? 'continue' : 'pause'), {}, 'pause');
    this.stop = button('Stop', () => this.#ask('stop'), { title: 'Save a checkpoint and end the run; it can be continued' });
    this.acts = h('div', { class: 'acts' }, ...(control ? [this.pause, this.stop] : []),
      ui.capture?.photos ? button('Compare', () => ui.compare(), { title: 'Image of the capture next to the render (Z)' }, 'photo') : null);
    this.card = h('section', { class: 'card live', 'aria-label': 'Training' },
      h('div', { class: 'row' }, this.dot, this.state, h('span', { class: 'space' }), this.left),
      this.plot, this.figures, this.acts);
    ui.left.append(this.card);
    ui.root.addEventListener('themechange', () => this.#draw());
    this.resizes = new ResizeObserver(() => this.#draw());
    this.resizes.observe(this.canvas);
    let newest = null;
    const show = number => {
      clearTimeout(this.timer);
      // A server that reports missed snapshots may name several: only the last is loaded.
      this.timer = setTimeout(() => {
        if (number === newest) return;
        newest = number;
        this.address = new URL(src, document.baseURI);
        this.address.searchParams.set('v', number);
        reload(this.address.href);
      }, TOGETHER);
    };
    this.reload = reload;
    if (version != null) show(version);
    const past = () => metrics && fetch(metrics).then(r => (r.ok ? r.text() : '')).then(text => text
      && this.#merge(readMetrics(text))).catch(() => { /* The curve then begins with what arrives. */ });
    this.feed = new Feed(events, {
      step: data => this.#step(data),
      snapshot: show,
      state: state => {
        this.#show(state);
        // A page that joins late or was disconnected requests what it missed.
        if (state === 'live') past();
      },
      other: data => {
        if (data.kind === 'done' || data.kind === 'finished') this.#finish();
        else if (data.kind === 'control') this.#controlled(data);
      },
    });
  }

  /** Requests the program to pause, continue or stop. */
  async #ask(what) {
    try {
      const answer = await fetch(this.control.address, { method: 'POST', body: JSON.stringify({ do: what }),
        headers: { 'content-type': 'application/json', 'x-splat4d-token': this.control.token } });
      if (!answer.ok) throw new Error(await answer.text());
      this.#controlled(await answer.json());
    } catch (error) { this.ui.toast(error.message, 5000); }
  }

  /** `state`: training, pausing, paused, stopping or stopped. */
  #controlled({ state, resume }) {
    this.at = state;
    if (state === 'stopped') {
      this.over = true;
      this.feed.close();
      this.card.append(h('small', {}, 'Saved. Continue with: ', h('code', {}, resume)));
    }
    this.#show(this.link);
  }

  #show(state) {
    this.link = state;
    const over = this.over || this.last?.step >= this.last?.of, { at } = this;
    const words = { pausing: 'Pausing', paused: 'Paused', stopping: 'Stopping', stopped: 'Stopped' }[at];
    this.dot.className = `dot ${state === 'live' && !over && !words ? 'on' : 'off'}`;
    this.acts.hidden = over && !this.ui.capture?.photos;
    for (const b of [this.pause, this.stop]) b.hidden = over;
    this.pause.replaceChildren(icon(at === 'paused' ? 'play' : 'pause'), at === 'paused' ? 'Continue' : 'Pause');
    this.pause.disabled = at === 'pausing' || at === 'stopping';
    this.stop.disabled = at === 'stopping';
    this.state.textContent = at === 'stopped' || (!over && words) ? words : over ? 'Training finished'
      : { connecting: this.last ? 'Reconnecting' : 'Connecting', live: 'Training', away: 'Reconnecting' }[state];
    if (!this.last && !over) this.figures.replaceChildren(h('small', { class: 'wait' }, FIRST));
  }

  /** The server may end with the run: the page keeps the scene, and requests nothing more. */
  async #finish() {
    if (this.over) return;
    this.over = true;
    this.left.textContent = '';
    this.feed.close();
    this.#show(this.link);
    // The last snapshot may have come together with the end.
    await new Promise(done => setTimeout(done, 2 * TOGETHER));
    if (!this.address) return;
    try {
      const answer = await fetch(this.address);
      if (!answer.ok) return;
      const scene = await answer.blob();
      this.reload(scene);
      this.card.append(button('Save the scene', () => save(scene, 'scene.s4d'), {}, 'save'));
    } catch { /* What has been loaded still plays. */ }
  }

  #step(data) {
    this.last = data;
    this.#merge([data]);
    this.#show(this.link);
    const count = n => Number(n).toLocaleString('en-GB');
    const left = s => (s > 5400 ? `${(s / 3600).toFixed(1)} h`
      : s > 90 ? `${Math.round(s / 60)} min` : `${Math.round(s)} s`);
    const cells = [
      [count(data.step), data.of ? `of ${count(data.of)} steps` : 'steps'],
      [isFinite(data.psnr) ? data.psnr.toFixed(2) : '–', 'dB, training views'],
      ...(isFinite(data.held) ? [[data.held.toFixed(2), 'dB, held out']] : []),
      [count(data.gaussians ?? 0), 'Gaussians'],
    ];
    this.left.textContent = data.left > 0 && !this.over ? `${left(data.left)} left` : '';
    this.figures.replaceChildren(...cells.map(([value, name]) => h('div', {}, value, h('small', {}, name))));
  }

  #merge(steps) {
    const known = new Map(this.#points.map(p => [p.step, p]));
    for (const s of steps) known.set(s.step, s);
    this.#points = [...known.values()].sort((a, b) => a.step - b.step);
    while (this.#points.length > CURVE_MAX) this.#points = this.#points.filter((_, i) => i % 2 === 0);
    this.#draw();
  }

  /** PSNR in the accent colour, the loss behind it; each over its own range. */
  #draw() {
    const { canvas } = this, box = canvas.getBoundingClientRect(), ratio = devicePixelRatio || 1;
    this.plot.hidden = this.#points.length < 2;
    if (!box.width || this.#points.length < 2) return;
    canvas.width = Math.round(box.width * ratio);
    canvas.height = Math.round(box.height * ratio);
    const g = canvas.getContext('2d'), style = getComputedStyle(canvas);
    const [first, last] = [this.#points[0].step, this.#points.at(-1).step];
    const edge = 3 * ratio, w = canvas.width - 2 * edge, height = canvas.height - 2 * edge;
    const values = (...keys) => this.#points.flatMap(p => keys.map(k => p[k])).filter(isFinite);
    const curve = (key, colour, width, range, dash = []) => {
      const points = this.#points.filter(p => isFinite(p[key]));
      const [low, high] = [Math.min(...range), Math.max(...range)];
      const digits = key === 'psnr' ? 1 : 3;
      this.axes[key]?.forEach((label, i) => { label.textContent = points.length ? [high, low][i].toFixed(digits) : ''; });
      g.beginPath();
      for (const p of points) {
        g.lineTo(edge + w * (p.step - first) / (last - first || 1),
          edge + height * (1 - (p[key] - low) / (high - low || 1)));
      }
      Object.assign(g, { strokeStyle: colour, lineWidth: width * ratio, lineJoin: 'round', lineCap: 'round' });
      g.setLineDash(dash.map(x => x * ratio));
      g.stroke();
    };
    this.psnrName.textContent = values('held').length ? 'PSNR, dB: training, held out (dotted)' : 'PSNR, training views, dB';
    this.axes.step.forEach((label, i) => { label.textContent = [first, last][i].toLocaleString('en-GB'); });
    curve('loss', style.getPropertyValue('--muted'), 1.5, values('loss'));
    curve('psnr', style.getPropertyValue('--accent'), 2, values('psnr', 'held'));
    curve('held', style.getPropertyValue('--accent'), 2, values('psnr', 'held'), [1, 4]);
    const psnr = this.#points.map(p => p.psnr);
    canvas.setAttribute('aria-label', `Quality over steps: PSNR from ${psnr[0].toFixed(1)} to ${
      psnr.at(-1).toFixed(1)} dB`);
  }

  close() {
    clearTimeout(this.timer);
    this.feed.close();
    this.resizes.disconnect();
    this.card.remove();
  }
}

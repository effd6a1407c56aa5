// The cameras of the capture in the scene, as frusta with their images, and the image of one camera next to its render.

import { add, bounds, clockOf, dot, norm, normalize, quatFromRows, quatTurn, readLink } from './camera.js';
import { h } from './dom.js';

/** Length of a frustum: of the median distance to the nearest camera, and at most of the scene's radius. */
const NEIGHBOUR_SHARE = 0.45, RADIUS_SHARE = 0.12;
/** Most cameras whose images are drawn, longer side of such an image, and least area of one on the page, pixels. */
const MOST_IMAGES = 64, THUMB_SIDE = 192, LEAST_AREA = 60;
/** Longer side of the image next to the render, pixels. */
const PHOTO_SIDE = 1280;
/** Rest of the clock after which the images of frusta are fetched again, ms. */
const REST = 400;
/** A click moves less, and lands nearer to a camera, pixels. */
const CLICK = 6, REACH = 16;
/** The first view of a capture: distance in radii of rig and scene, height against it, and target on the way to the cameras. */
const AWAY = 1.9, HEIGHT = 0.45, TOWARDS = 0.4;
const HELD = '#ffb224', LINE = '#fff';

/** {quat, position, corners(length)} of an entry of the list. */
function pose(c) {
  const m = c.world_from_camera;
  const quat = quatFromRows([0, 4, 8].map(i => m.slice(i, i + 3))), position = [m[3], m[7], m[11]];
  const corner = (x, y, s) => add(position, quatTurn(quat, [(x - c.cx) / c.fx * s, (y - c.cy) / c.fy * s, s]));
  return { position, corners: s => [[0, 0], [c.width, 0], [0, c.height], [c.width, c.height]].map(([x, y]) => corner(x, y, s)) };
}

export class Rig {
  shown = false;
  compared = false;
  #frame = 0;
  #thumbs = new Map();
  #timer = 0;
  #asked = null;
  #busy = false;
  #again = false;

  /** `photos`: the address of images; null: there are none. */
  constructor(ui, { photos = null, overview = false } = {}) {
    Object.assign(this, { ui, player: ui.player, photos });
    this.canvas = h('canvas', { class: 'frusta', 'aria-hidden': 'true' });
    this.player.stage.append(this.canvas);
    this.image = h('img', { alt: '' });
    this.caption = h('figcaption', { class: 'card' });
    this.photo = h('figure', { class: 'photo', hidden: true }, this.image, this.caption);
    this.player.stage.after(this.photo);
    const on = (name, f) => this.player.addEventListener(name, f);
    on('scene', () => this.#adopt());
    on('camerachange', () => this.redraw());
    on('viewed', () => { this.redraw(); this.#photo(); });
    on('timeupdate', () => { this.#photo(); this.#rest(); });
    this.resizes = new ResizeObserver(() => this.redraw());
    this.resizes.observe(this.player.stage);
    let down = null;
    this.player.stage.addEventListener('pointerdown', e => { down = [e.clientX, e.clientY]; });
    this.player.stage.addEventListener('pointerup', e => {
      if (down && this.shown && Math.hypot(e.clientX - down[0], e.clientY - down[1]) < CLICK) this.#pick(e);
      down = null;
    });
    this.#adopt();
    if (overview) this.#overview();
  }

  get cameras() { return this.player.meta?.cameras ?? []; }

  #adopt() {
    this.poses = this.cameras.map(pose);
    const near = this.poses.map((a, i) => Math.min(...this.poses.flatMap((b, j) => (
      i === j ? [] : [norm(add(a.position, b.position, -1))])))).filter(d => isFinite(d) && d > 0).sort((a, b) => a - b);
    const { radius } = bounds(this.player.meta);
    this.length = Math.min(NEIGHBOUR_SHARE * (near[near.length >> 1] ?? Infinity), RADIUS_SHARE * radius) || 1;
    this.redraw();
  }

  /** Shows scene and cameras from behind the cameras, unless the page's address states a position. */
  #overview() {
    if (!this.poses.length || readLink(location.hash).camera) return;
    const { center, radius } = bounds(this.player.meta), { up } = this.player.camera, n = this.poses.length;
    const middle = this.poses.reduce((sum, p) => add(sum, p.position, 1 / n), [0, 0, 0]);
    const far = Math.max(radius, ...this.poses.map(p => norm(add(p.position, center, -1))));
    let away = add(middle, center, -1);
    away = add(away, up, -dot(away, up));
    const side = norm(away) > 0.05 * far ? normalize(away) : normalize(add(this.player.camera.forward.map(x => -x), up, 0));
    const target = add(center, add(middle, center, -1), TOWARDS);
    this.player.setCamera({ position: add(add(center, side, AWAY * far), up, HEIGHT * AWAY * far), target, up });
  }

  show(on) {
    this.shown = on;
    if (on) this.#images();
    this.redraw();
  }

  /** Splits the page: the render of the chosen camera, and its image. */
  compare(on) {
    this.compared = on && !!this.photos;
    this.photo.hidden = !this.compared;
    this.ui.root.classList.toggle('compared', this.compared);
    if (!this.compared) return;
    if (this.player.viewed == null) this.player.view(this.number ?? 0);
    this.#photo();
  }

  redraw() {
    cancelAnimationFrame(this.#frame);
    this.#frame = requestAnimationFrame(() => this.#draw());
  }

  #project(p) {
    const m = this.view.cameraFromWorld;
    const [x, y, z] = [0, 4, 8].map(k => m[k] * p[0] + m[k + 1] * p[1] + m[k + 2] * p[2] + m[k + 3]);
    return z > 1e-6 ? [this.view.fx * x / z + this.view.cx, this.view.fy * y / z + this.view.cy, z] : null;
  }

  #draw() {
    const { canvas } = this, { stage } = this.player, ratio = Math.min(devicePixelRatio || 1, 2);
    const [w, tall] = [stage.clientWidth, stage.clientHeight].map(x => Math.max(x, 1));
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(tall * ratio);
    this.places = [];
    if (!this.shown || !this.player.file) return;
    const g = canvas.getContext('2d');
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.view = this.player.camera.view(w, tall);
    const seen = this.poses.map((p, i) => ({ i, at: this.#project(p.position), corners: p.corners(this.length).map(c => this.#project(c)) }))
      .filter(s => s.at && s.corners.every(Boolean) && s.i !== this.player.viewed).sort((a, b) => b.at[2] - a.at[2]);
    for (const { i, at, corners } of seen) {
      this.places.push({ i, at });
      const [tl, tr, bl, br] = corners, image = this.#thumbs.get(i);
      const area = Math.abs((tr[0] - tl[0]) * (bl[1] - tl[1]) - (tr[1] - tl[1]) * (bl[0] - tl[0]));
      if (image && area > LEAST_AREA) {
        // Frusta are small on the page: a parallelogram is close to the perspective image.
        g.save();
        g.transform((tr[0] - tl[0]) / image.width, (tr[1] - tl[1]) / image.width, (bl[0] - tl[0]) / image.height,
          (bl[1] - tl[1]) / image.height, tl[0], tl[1]);
        g.drawImage(image, 0, 0);
        g.restore();
      }
      g.beginPath();
      for (const [a, b] of [[tl, tr], [tr, br], [br, bl], [bl, tl], [at, tl], [at, tr], [at, br], [at, bl]]) {
        g.moveTo(a[0], a[1]);
        g.lineTo(b[0], b[1]);
      }
      const colour = this.cameras[i].held ? HELD : LINE;
      for (const [style, wide] of [['rgba(0,0,0,.55)', 2.6], [colour, 1.1]]) {
        Object.assign(g, { strokeStyle: style, lineWidth: wide, lineJoin: 'round' });
        g.stroke();
      }
    }
  }

  /** A click on a camera shows its view. */
  #pick(e) {
    const box = this.player.stage.getBoundingClientRect(), at = [e.clientX - box.left, e.clientY - box.top];
    const away = p => Math.hypot(p.at[0] - at[0], p.at[1] - at[1]);
    const [best] = this.places.filter(p => away(p) < REACH).sort((a, b) => away(a) - away(b));
    if (best) this.player.view(best.i);
  }

  // Images.

  #address(i, side) {
    return `${this.photos}?view=${i}&t=${+this.player.time.toFixed(4)}&side=${side}`;
  }

  #rest() {
    if (!this.shown || this.player.playing) return;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#images(), REST);
  }

  /** One after the other: the server handles two requests at a time. */
  async #images() {
    if (!this.photos) return;
    const asked = this.#asked = {}, stride = Math.ceil(this.cameras.length / MOST_IMAGES);
    for (let i = 0; i < this.cameras.length; i += stride) {
      if (this.cameras[i].time != null && this.#thumbs.has(i)) continue;
      try {
        const answer = await fetch(this.#address(i, THUMB_SIDE));
        if (answer.ok) this.#thumbs.set(i, await createImageBitmap(await answer.blob()));
      } catch { return; /* The server has gone; frusta stay without images. */ }
      if (this.#asked !== asked) return;
      this.redraw();
    }
  }

  /** The image of the chosen camera at the time that is shown. */
  async #photo() {
    if (this.player.viewed != null) this.number = this.player.viewed;
    const { number } = this, camera = this.cameras[number];
    if (!this.compared || !camera) return;
    if (this.#busy) { this.#again = true; return; }
    this.#busy = true;
    try {
      const answer = await fetch(this.#address(number, PHOTO_SIDE));
      if (!answer.ok) throw new Error();
      const time = Number(answer.headers.get('x-splat4d-time')), url = URL.createObjectURL(await answer.blob());
      this.image.src = url;
      await this.image.decode().catch(() => {});
      URL.revokeObjectURL(url);
      this.image.alt = `Image of ${camera.name}`;
      this.caption.textContent = [camera.name, `${(time - this.player.first).toFixed(3)} s`, clockOf(camera),
        camera.held ? 'held out' : null].filter(Boolean).join(' · ');
    } catch { this.caption.textContent = `${camera.name} · the image cannot be read`; }
    this.#busy = false;
    if (this.#again) { this.#again = false; this.#photo(); }
  }
}

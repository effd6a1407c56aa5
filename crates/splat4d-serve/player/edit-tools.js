// Overlays of the image while editing, and their interaction: shapes, dots of what is selected, handles of a
// move, nodes of a bend. Works on any backend: it is a canvas of its own.

import { add, cross, normalize, quatAbout, quatMul, quatTurn } from './camera.js';

/** Pixels: length of a move's arrows, of its rings' radius and of the distance to its scale handle, of a dot, of a node. */
const ARROW = 84, RING = 62, KNOB = 56, DOT = 1.6, NODE = 3.2;
/** Distance of a pointer that counts as a hit, pixels: a mouse, a finger. */
const NEAR = { mouse: 9, pen: 12, touch: 20 };
/** A tap moves less than this, pixels. */
const TAP = 5;
/** Most corners of a lasso, and pixels between two. */
const CORNERS = 48, CORNER_STEP = 5;
/** Segments of a ring. */
const SEGMENTS = 48;
/** Pixels of the scale handle for a factor of e. */
const SCALE_PIXELS = 120;
const AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
const COLORS = ['#e5484d', '#46a758', '#3b82f6'];
const SELECTED = '#ffb224', HELD = '#e5484d', PINNED = '#8b8d98';
const DRAWING = ['box', 'sphere', 'lasso', 'color'];

export class Overlay extends EventTarget {
  /** null, one of DRAWING, 'move' or 'bend'. */
  tool = null;
  /** Places of selected Gaussians, and the similarity that they have been moved by. */
  points = [];
  place = null;
  /** The box of the selection, {low, high}, whose faces can be pulled. */
  box = null;
  /** Nodes: where they are, and of them {node, by} pulled and numbers pinned. */
  nodes = [];
  pulled = [];
  pinned = [];
  #picture = null;
  #gesture = null;
  #frame = 0;

  constructor(player) {
    super();
    this.player = player;
    this.stage = player.stage;
    this.canvas = document.createElement('canvas');
    this.canvas.className = 'edit-overlay';
    this.canvas.setAttribute('aria-hidden', 'true');
    this.stage.append(this.canvas);
    const on = (name, f) => this.stage.addEventListener(name, f, { capture: true });
    on('pointerdown', e => this.#down(e));
    on('pointermove', e => this.#move(e));
    for (const name of ['pointerup', 'pointercancel']) on(name, e => this.#up(e));
    this.resizes = new ResizeObserver(() => this.redraw());
    this.resizes.observe(this.stage);
    player.addEventListener('camerachange', () => this.redraw());
  }

  #emit(name, detail = {}) { this.dispatchEvent(new CustomEvent(name, { detail })); }

  setTool(tool) {
    this.tool = tool;
    this.#gesture = null;
    this.stage.style.cursor = DRAWING.includes(tool) ? 'crosshair' : '';
    this.redraw();
  }

  /** An image of the server's in place of the player's; null takes it away. */
  async show(source) {
    if (!source) this.#picture = null;
    else {
      const image = new Image();
      image.src = source;
      await image.decode();
      this.#picture = image;
    }
    this.redraw();
  }
  /** Whether a hand is at work. */
  get busy() { return !!this.#gesture; }
  get shows() { return !!this.#picture; }

  redraw() {
    cancelAnimationFrame(this.#frame);
    this.#frame = requestAnimationFrame(() => this.draw());
  }

  // Between the world and the page, in CSS pixels.

  get view() { return this.player.camera.view(Math.max(this.stage.clientWidth, 1), Math.max(this.stage.clientHeight, 1)); }

  /** [x, y, depth]; null behind the camera. */
  project(p, view = this.view) {
    const m = view.cameraFromWorld;
    const [x, y, z] = [0, 4, 8].map(k => m[k] * p[0] + m[k + 1] * p[1] + m[k + 2] * p[2] + m[k + 3]);
    return z > 1e-6 ? [view.fx * x / z + view.cx, view.fy * y / z + view.cy, z] : null;
  }

  /** Corners as x/z and y/z in the camera's axes. */
  corners(pixels) {
    const v = this.view;
    return pixels.map(([x, y]) => [(x - v.cx) / v.fx, (y - v.cy) / v.fy]);
  }

  /** World displacement of a way of pixels across the image at a depth. */
  #across([dx, dy], z) {
    const { fx, fy } = this.view, c = this.player.camera;
    return add(c.right.map(x => x * dx * z / fx), c.down, dy * z / fy);
  }

  #moved(p) {
    const { shift, quat, scale, about } = this.place;
    return add(add(quatTurn(quat, add(p, about, -1)).map(x => x * scale), about), shift);
  }

  // Hands.

  #at(e) {
    const box = this.stage.getBoundingClientRect();
    return [e.clientX - box.left, e.clientY - box.top];
  }

  #down(e) {
    if (!this.tool && !this.box) return;
    const g = this.#gesture;
    if (g) {
      // A second finger moves the camera, and takes the first along.
      if (e.pointerType === 'touch' && e.pointerId !== g.id) {
        this.#gesture = null;
        if (g.undo) g.undo();
        this.player.controls.take(g.first);
        this.redraw();
      }
      return;
    }
    if (e.button !== 0 || e.shiftKey || e.altKey) return;
    const at = this.#at(e), reach = NEAR[e.pointerType] ?? NEAR.mouse;
    const own = this.#face(at, reach) ?? (!this.tool ? null : DRAWING.includes(this.tool) ? { kind: 'draw', path: [at] }
      : this.tool === 'move' ? this.#grip(at, reach) : this.#grab(at, reach));
    if (!own) return;
    e.stopImmediatePropagation();
    e.preventDefault();
    this.stage.focus?.({ preventScroll: true });
    this.stage.setPointerCapture(e.pointerId);
    const first = { pointerId: e.pointerId, clientX: e.clientX, clientY: e.clientY, target: this.stage };
    this.#gesture = { ...own, id: e.pointerId, from: at, at, first };
    this.redraw();
  }

  #move(e) {
    const g = this.#gesture;
    if (!g || e.pointerId !== g.id) return;
    e.stopImmediatePropagation();
    g.at = this.#at(e);
    g.far ||= Math.hypot(g.at[0] - g.from[0], g.at[1] - g.from[1]) > TAP;
    if (g.kind === 'draw') {
      const last = g.path.at(-1);
      if (Math.hypot(g.at[0] - last[0], g.at[1] - last[1]) >= CORNER_STEP) g.path.push(g.at);
    } else if (g.far) g.follow(g.at);
    this.redraw();
  }

  #up(e) {
    const g = this.#gesture;
    if (!g || e.pointerId !== g.id) return;
    e.stopImmediatePropagation();
    this.#gesture = null;
    if (e.type === 'pointercancel') g.undo?.();
    else if (g.kind === 'draw') this.#drawn(g);
    else if (g.far) g.end();
    else g.tap?.();
    this.redraw();
  }

  #drawn(g) {
    if (this.tool === 'color') return this.#emit('drawn', { shape: 'color', corners: this.corners([g.from]) });
    if (!g.far) return;
    let path = [g.from, g.at];
    if (this.tool === 'lasso') {
      const step = Math.max(1, g.path.length / CORNERS);
      path = Array.from({ length: Math.min(g.path.length, CORNERS) }, (_, i) => g.path[Math.floor(i * step)]);
      if (path.length < 3) return;
    }
    this.#emit('drawn', { shape: this.tool, corners: this.corners(path) });
  }

  /** The handles of a move: centre, arrows, rings, scale. */
  #gizmo() {
    if (!this.place) return null;
    const center = add(this.place.about, this.place.shift), view = this.view, c = this.project(center, view);
    if (!c) return null;
    const unit = c[2] / view.fx;
    const arrows = AXES.map(a => this.project(add(center, a, ARROW * unit), view));
    const rings = AXES.map(axis => {
      const u = normalize(cross(axis, Math.abs(axis[0]) < 0.5 ? AXES[0] : AXES[1])), v = cross(axis, u);
      return Array.from({ length: SEGMENTS + 1 }, (_, i) => {
        const t = 2 * Math.PI * i / SEGMENTS;
        return this.project(add(add(center, u, RING * unit * Math.cos(t)), v, RING * unit * Math.sin(t)), view);
      });
    });
    return { center, c, unit, arrows, rings, knob: [c[0] + KNOB, c[1] - KNOB] };
  }

  #grip(at, reach) {
    const g = this.#gizmo();
    if (!g) return null;
    const before = this.place;
    const gesture = follow => ({
      kind: 'grip', follow: now => { this.place = { ...before, ...follow([now[0] - at[0], now[1] - at[1]]) }; this.#emit('moving'); },
      end: () => this.#emit('moved', { place: this.place }), undo: () => { this.place = before; },
    });
    if (far(at, g.c) <= reach) return gesture(way => ({ shift: add(before.shift, this.#across(way, g.c[2])) }));
    if (far(at, g.knob) <= reach) {
      return gesture(([x, y]) => ({ scale: before.scale * Math.exp((x - y) / SCALE_PIXELS) }));
    }
    for (let k = 0; k < 3; k++) {
      const tip = g.arrows[k], way = tip && [tip[0] - g.c[0], tip[1] - g.c[1]];
      // An arrow that points at the eye cannot be pulled along.
      if (!tip || Math.hypot(...way) < reach || segment(at, between(g.c, tip, 0.3), tip) > reach) continue;
      return gesture(([x, y]) => ({
        shift: add(before.shift, AXES[k], ARROW * g.unit * (x * way[0] + y * way[1]) / (way[0] ** 2 + way[1] ** 2)),
      }));
    }
    for (let k = 0; k < 3; k++) {
      const ring = g.rings[k];
      const i = ring.findIndex((p, i) => p && ring[i + 1] && segment(at, p, ring[i + 1]) <= reach);
      if (i < 0) continue;
      const [a, b] = [ring[i], ring[i + 1]], angle = 2 * Math.PI / SEGMENTS;
      const way = [(b[0] - a[0]) / angle, (b[1] - a[1]) / angle], square = Math.max(way[0] ** 2 + way[1] ** 2, 100);
      return gesture(([x, y]) => ({
        quat: quatMul(quatAbout(AXES[k], (x * way[0] + y * way[1]) / square), before.quat),
      }));
    }
    return null;
  }

  /** Middles of the box's faces on the image: [axis, 'low' or 'high', place, [x, y, depth]]. */
  #faces() {
    if (!this.box || ['move', 'bend'].includes(this.tool)) return [];
    const { low, high } = this.box, view = this.view;
    return [0, 1, 2].flatMap(k => ['low', 'high'].map(end => {
      const place = low.map((x, i) => (i === k ? this.box[end][k] : (x + high[i]) / 2));
      return [k, end, place, this.project(place, view)];
    })).filter(face => face[3]);
  }

  #face(at, reach) {
    const found = this.#faces().filter(face => far(at, face[3]) <= reach).sort((a, b) => a[3][2] - b[3][2])[0];
    if (!found) return null;
    const [k, end, place, c] = found, before = this.box, unit = c[2] / this.view.fx;
    const tip = this.project(add(place, AXES[k], ARROW * unit)), way = tip && [tip[0] - c[0], tip[1] - c[1]];
    // A face that is seen from straight ahead cannot be pulled along.
    if (!tip || Math.hypot(...way) < reach) return null;
    return {
      kind: 'face', undo: () => { this.box = before; this.#emit('boxing', { box: before }); },
      follow: ([x, y]) => {
        const by = ARROW * unit * ((x - at[0]) * way[0] + (y - at[1]) * way[1]) / (way[0] ** 2 + way[1] ** 2);
        const to = before[end][k] + by, limit = before[end === 'low' ? 'high' : 'low'][k];
        const put = end === 'low' ? Math.min(to, limit) : Math.max(to, limit);
        this.box = { ...before, [end]: before[end].map((v, i) => (i === k ? put : v)) };
        this.#emit('boxing', { box: this.box });
      },
      end: () => this.#emit('boxed', { box: this.box }),
    };
  }

  #grab(at, reach) {
    const view = this.view;
    let best = null;
    this.nodes.forEach((p, node) => {
      const q = this.project(p, view);
      const away = q && far(at, q);
      // Of nodes that are about as near on the image, the one in front.
      if (q && away <= reach && (!best || q[2] + away * q[2] / view.fx * 4 < best.key)) {
        best = { node, z: q[2], key: q[2] + away * q[2] / view.fx * 4 };
      }
    });
    if (!best) return null;
    const { node, z } = best, old = this.pulled, held = old.find(p => p.node === node);
    const from = held?.by ?? [0, 0, 0];
    return {
      kind: 'pull', undo: () => { this.pulled = old; this.#emit('pulling'); },
      follow: now => {
        const by = add(from, this.#across([now[0] - at[0], now[1] - at[1]], z));
        this.pulled = [...old.filter(p => p.node !== node), { node, by }];
        this.pinned = this.pinned.filter(n => n !== node);
        this.#emit('pulling');
      },
      end: () => this.#emit('pulled', { node }), tap: () => this.#emit('pin', { node }),
    };
  }

  // The image.

  draw() {
    const { canvas } = this, ratio = Math.min(devicePixelRatio || 1, 2);
    const [w, h] = [this.stage.clientWidth, this.stage.clientHeight];
    if (canvas.width !== Math.round(w * ratio)) canvas.width = Math.round(w * ratio);
    if (canvas.height !== Math.round(h * ratio)) canvas.height = Math.round(h * ratio);
    const g = canvas.getContext('2d');
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, w, h);
    if (this.#picture) g.drawImage(this.#picture, 0, 0, w, h);
    if (this.tool !== 'bend') this.#dots(g);
    this.#drawBox(g);
    if (this.tool === 'move') this.#drawGizmo(g);
    if (this.tool === 'bend') this.#drawNodes(g);
    this.#drawShape(g);
  }

  #dots(g) {
    if (!this.points.length) return;
    const view = this.view, ink = new Path2D(), halo = new Path2D();
    for (const p of this.points) {
      const q = this.project(this.place ? this.#moved(p) : p, view);
      if (!q) continue;
      halo.rect(q[0] - DOT - 0.7, q[1] - DOT - 0.7, 2 * DOT + 1.4, 2 * DOT + 1.4);
      ink.rect(q[0] - DOT, q[1] - DOT, 2 * DOT, 2 * DOT);
    }
    g.fillStyle = 'rgba(0,0,0,.45)';
    g.fill(halo);
    g.fillStyle = SELECTED;
    g.fill(ink);
  }

  #drawBox(g) {
    const faces = this.#faces();
    if (!faces.length) return;
    const { low, high } = this.box, view = this.view;
    const corner = n => this.project(low.map((x, k) => (n >> k & 1 ? high[k] : x)), view);
    g.beginPath();
    for (let n = 0; n < 8; n++) {
      for (let k = 0; k < 3; k++) {
        const [a, b] = n >> k & 1 ? [] : [corner(n), corner(n | 1 << k)];
        // An edge that passes the camera is left out.
        if (a && b) { g.moveTo(a[0], a[1]); g.lineTo(b[0], b[1]); }
      }
    }
    for (const [style, wide] of [['rgba(0,0,0,.5)', 3], ['#fff', 1.2]]) {
      Object.assign(g, { strokeStyle: style, lineWidth: wide });
      g.stroke();
    }
    for (const [k, , , c] of faces) disc(g, c, 5, COLORS[k]);
  }

  #drawGizmo(g) {
    const z = this.#gizmo();
    if (!z) return;
    const line = (points, color, width) => {
      g.beginPath();
      let open = false;
      for (const p of points) { if (!p) open = false; else if (open) g.lineTo(p[0], p[1]); else { g.moveTo(p[0], p[1]); open = true; } }
      for (const [style, wide] of [['rgba(0,0,0,.5)', width + 2], [color, width]]) {
        Object.assign(g, { strokeStyle: style, lineWidth: wide, lineCap: 'round', lineJoin: 'round' });
        g.stroke();
      }
    };
    z.rings.forEach((ring, k) => line(ring, COLORS[k], 1.6));
    z.arrows.forEach((tip, k) => tip && line([z.c, tip], COLORS[k], 3));
    z.arrows.forEach((tip, k) => tip && disc(g, tip, 6, COLORS[k]));
    line([z.c, z.knob], '#fff', 1);
    g.fillStyle = '#fff';
    g.fillRect(z.knob[0] - 5, z.knob[1] - 5, 10, 10);
    disc(g, z.c, 7, SELECTED);
  }

  #drawNodes(g) {
    const view = this.view;
    const held = new Set(this.pulled.map(p => p.node)), pinned = new Set(this.pinned);
    // The nearest last, so that they lie on top.
    const list = this.nodes.map((p, i) => [this.project(p, view), i]).filter(([q]) => q).sort((a, b) => b[0][2] - a[0][2]);
    for (const [q, i] of list) {
      if (held.has(i)) disc(g, q, 2.2 * NODE, HELD);
      else if (pinned.has(i)) disc(g, q, 1.8 * NODE, PINNED);
      else disc(g, q, NODE, SELECTED);
    }
  }

  #drawShape(g) {
    const s = this.#gesture;
    if (s?.kind !== 'draw' || !s.far) return;
    g.beginPath();
    if (this.tool === 'box') g.rect(s.from[0], s.from[1], s.at[0] - s.from[0], s.at[1] - s.from[1]);
    else if (this.tool === 'sphere') g.arc(...s.from, far(s.from, s.at), 0, 7);
    else s.path.forEach(p => g.lineTo(...p));
    g.closePath();
    g.fillStyle = 'rgba(255,178,36,.16)';
    g.fill();
    Object.assign(g, { strokeStyle: SELECTED, lineWidth: 2 });
    g.stroke();
  }

  destroy() {
    cancelAnimationFrame(this.#frame);
    this.resizes.disconnect();
    this.canvas.remove();
  }
}

const far = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
const between = (a, b, u) => [a[0] + u * (b[0] - a[0]), a[1] + u * (b[1] - a[1])];
/** Distance of a point to a line from a to b. */
function segment(p, a, b) {
  const d = [b[0] - a[0], b[1] - a[1]];
  const u = ((p[0] - a[0]) * d[0] + (p[1] - a[1]) * d[1]) / (d[0] ** 2 + d[1] ** 2 || 1);
  return far(p, between(a, b, Math.min(1, Math.max(0, u))));
}
function disc(g, [x, y], r, color) {
  g.beginPath();
  g.arc(x, y, r, 0, 7);
  g.fillStyle = color;
  g.fill();
  Object.assign(g, { strokeStyle: 'rgba(0,0,0,.55)', lineWidth: 1 });
  g.stroke();
}

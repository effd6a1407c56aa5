// Moves the camera: mouse, touch, wheel and held keys; orbiting about the target, or flying.

import { DEGREE, FOV_RANGE, add, clamp, dot, quatAbout, quatMul } from './camera.js';

/** A drag across the window's shorter side turns half a circle. */
const TURN_PER_SIDE = Math.PI;
/** A pinch on a touch pad arrives as a wheel event with ctrl and small steps. */
const PINCH = 5;
/** Nearest to straight up or down, radians: beyond it left and right would change sides. */
const POLE = 89 * DEGREE;
/** One wheel notch (100 px) is a step of about 15 %. */
const WHEEL_RATE = 0.0015;
/** Pixels of a wheel step given in lines, as browsers scroll. */
const LINE = 16;
/** Scene radii a second that the keys fly; shift is three times as fast. */
const FLY_SPEED = 0.6;
const FLY_FAST = 3;
/** Radians a second of turning by the keyboard. */
const KEY_TURN = 1.2;
/** Seconds in which the swing after a drag fades to a third. */
const SWING = 0.12;
/** Nearest and farthest orbit, scene radii. */
const REACH = [1e-3, 1e3];

export class Controls {
  mode = 'orbit';
  /** Whether the wheel zooms: an embedded scene leaves the page's scrolling alone until it is in use. */
  wheelWanted = () => true;
  swing = !matchMedia('(prefers-reduced-motion: reduce)').matches;
  #pointers = new Map();
  #held = new Set();
  #velocity = [0, 0];
  #moved = 0;

  /** `host`: {camera, radius, moved(), loosen()}; loosen() is called before the camera leaves its place. */
  constructor(stage, host) {
    this.stage = stage;
    this.host = host;
    const on = (name, f, options) => stage.addEventListener(name, f, options);
    on('pointerdown', e => this.#down(e));
    on('pointermove', e => this.#move(e));
    for (const name of ['pointerup', 'pointercancel', 'lostpointercapture']) on(name, e => this.#up(e));
    on('wheel', e => this.#wheel(e), { passive: false });
    on('contextmenu', e => e.preventDefault());
  }

  /** A finger that something else held until now. */
  take(e) { this.#down(e); }

  get busy() { return this.#pointers.size > 0 || this.#held.size > 0; }

  #down(e) {
    if (e.target.closest?.('button, input, a')) return;
    this.stage.setPointerCapture(e.pointerId);
    this.#velocity = [0, 0];
    this.#pointers.set(e.pointerId, { x: e.clientX, y: e.clientY });
  }

  #up(e) {
    this.#pointers.delete(e.pointerId);
    // A finger or button that rested before it left throws nothing.
    if (performance.now() - this.#moved > 1000 * SWING) this.#velocity = [0, 0];
  }

  #move(e) {
    const at = this.#pointers.get(e.pointerId);
    if (!at) return;
    const before = [...this.#pointers.values()].map(p => ({ ...p }));
    const [dx, dy] = [e.clientX - at.x, e.clientY - at.y];
    Object.assign(at, { x: e.clientX, y: e.clientY });
    if (this.#pointers.size === 1) {
      const pan = e.pointerType !== 'touch' && (e.shiftKey || e.buttons & 6);
      if (pan) this.#pan(dx, dy);
      else {
        const k = TURN_PER_SIDE / this.#side();
        // The mouse turns the view; a finger moves the scene.
        const sign = this.mode === 'fly' && e.pointerType === 'touch' ? 1 : -1;
        this.turn(sign * dx * k, sign * dy * k);
        const now = performance.now(), dt = Math.max((now - this.#moved) / 1000, 1 / 240);
        this.#velocity = dt < SWING && this.swing ? [sign * dx * k / dt, sign * dy * k / dt] : [0, 0];
        this.#moved = now;
      }
    } else if (this.#pointers.size === 2) {
      const [a, b] = before, [c, d] = [...this.#pointers.values()];
      const far = (p, q) => Math.max(Math.hypot(p.x - q.x, p.y - q.y), 1);
      this.zoom(far(a, b) / far(c, d));
      this.#pan((c.x + d.x - a.x - b.x) / 2, (c.y + d.y - a.y - b.y) / 2);
    }
  }

  #wheel(e) {
    if (!this.wheelWanted(e)) return;
    e.preventDefault();
    const step = e.deltaY * (e.deltaMode ? LINE : 1) * (e.ctrlKey ? PINCH : 1);
    if (e.altKey) {
      this.host.loosen();
      this.host.camera.fov = clamp(this.host.camera.fov * Math.exp(step * WHEEL_RATE / 2), ...FOV_RANGE);
      this.host.moved();
    } else if (this.mode === 'fly') this.#fly([0, 0, -step * WHEEL_RATE * this.host.radius]);
    else this.zoom(Math.exp(step * WHEEL_RATE));
  }

  #side() { return Math.max(Math.min(this.stage.clientWidth, this.stage.clientHeight), 1); }

  /** Radians about the world's up and about the camera's right; both turn about the target when orbiting. */
  turn(yaw, pitch) {
    this.host.loosen();
    const c = this.host.camera, target = c.target;
    const height = Math.asin(clamp(dot(c.forward, c.up), -1, 1));
    const limit = Math.max(POLE, Math.abs(height));
    pitch = clamp(height + pitch, -limit, limit) - height;
    c.quat = quatMul(quatAbout(c.up, yaw), quatMul(quatAbout(c.right, pitch), c.quat));
    if (this.mode === 'orbit') c.position = add(target, c.forward, -c.distance);
    this.host.moved();
  }

  /** Pixels: the point at the target's distance follows the pointer. */
  #pan(dx, dy) {
    this.host.loosen();
    const c = this.host.camera;
    const unit = 2 * c.distance * Math.tan(c.fov * DEGREE / 2) / this.#side();
    c.position = add(add(c.position, c.right, -dx * unit), c.down, -dy * unit);
    this.host.moved();
  }

  /** Multiplies the distance to the target, which stays. */
  zoom(factor) {
    this.host.loosen();
    const c = this.host.camera, target = c.target, r = this.host.radius;
    c.distance = clamp(c.distance * factor, REACH[0] * r, REACH[1] * r);
    c.position = add(target, c.forward, -c.distance);
    this.host.moved();
  }

  /** Scene units to the right, up (the world's) and ahead. */
  #fly([x, y, z]) {
    this.host.loosen();
    const c = this.host.camera;
    c.position = add(add(add(c.position, c.right, x), c.up, y), c.forward, z);
    this.host.moved();
  }

  /** A key goes down or up; true where it is one of the controls' own. */
  key(code, down) {
    if (!/^(Key[WASDQE]|Shift(Left|Right)|Turn(Left|Right|Up|Down))$/.test(code)) return false;
    this.#held[down ? 'add' : 'delete'](code);
    return !code.startsWith('Shift');
  }

  release() { this.#held.clear(); }

  /** Moves on by dt seconds: held keys, and the swing after a drag. */
  tick(dt) {
    const has = code => +this.#held.has(code);
    const way = [has('KeyD') - has('KeyA'), has('KeyE') - has('KeyQ'), has('KeyW') - has('KeyS')];
    if (way.some(Boolean)) {
      const fast = has('ShiftLeft') || has('ShiftRight') ? FLY_FAST : 1;
      this.#fly(way.map(x => x * dt * FLY_SPEED * fast * this.host.radius));
    }
    const turn = [has('TurnRight') - has('TurnLeft'), has('TurnUp') - has('TurnDown')];
    if (turn.some(Boolean)) this.turn(turn[0] * dt * KEY_TURN, -turn[1] * dt * KEY_TURN);
    if (!this.#pointers.size && Math.hypot(...this.#velocity) > 0.01) {
      this.turn(this.#velocity[0] * dt, this.#velocity[1] * dt);
      this.#velocity = this.#velocity.map(v => v * Math.exp(-dt / SWING));
    }
  }

  /** Ends the swing, where something else takes the camera. */
  still() { this.#velocity = [0, 0]; }
}

// Camera paths by key frames, in the format of `splat4d render --path keys.json`, and with its interpolation:
// Catmull-Rom positions, great arcs, straight lines for field of view and scene time.

import { Camera, add, clamp, lerp, norm, quatFromRows, quatMul, quatAbout, slerp, vector } from './camera.js';

const KEYS = ['time', 'scene_time', 'position', 'look_at', 'up', 'fov_y', 'world_to_camera'];
/** Seconds of film between two keys without scene times. */
const GAP = 2;
/** Seconds of the turn about the target that bullet time makes where no path is set. */
const TURN = 8;

const plain = x => typeof x === 'number' && isFinite(x);

export class Track {
  /** [{time, sceneTime | null, camera}] in order of time. */
  keys = [];
  fps = 30;

  get seconds() { return this.keys.length ? this.keys.at(-1).time - this.keys[0].time : 0; }

  /** Adds a key at the end; the film takes as long as the scene does between the two. */
  add(camera, sceneTime) {
    const last = this.keys.at(-1);
    const between = last && sceneTime !== null && last.sceneTime !== null ? sceneTime - last.sceneTime : 0;
    const time = last ? last.time + (between > 0.05 ? between : GAP) : 0;
    const kept = camera.clone();
    kept.lens = null;
    this.keys.push({ time, sceneTime, camera: kept });
  }

  /** Moves a key to another second of the film; it stays between its neighbours. */
  move(i, time) {
    const [a, b] = [this.keys[i - 1]?.time ?? -Infinity, this.keys[i + 1]?.time ?? Infinity];
    if (time > a && time < b) this.keys[i].time = time;
  }

  /** {camera, sceneTime | null} at a second of the film; 0 is the first key. */
  at(seconds) {
    const keys = this.keys, n = keys.length, t = keys[0].time + seconds;
    let j = keys.findIndex(k => k.time > t);
    j = clamp(j < 0 ? n - 1 : j, Math.min(1, n - 1), n - 1);
    const i = Math.max(j - 1, 0), a = keys[i], b = keys[j];
    const u = j > i ? clamp((t - a.time) / (b.time - a.time), 0, 1) : 0;
    const camera = b.camera.clone();
    camera.quat = slerp(a.camera.quat, b.camera.quat, u);
    camera.fov = lerp(a.camera.fov, b.camera.fov, u);
    camera.distance = lerp(a.camera.distance, b.camera.distance, u);
    camera.position = this.#spline(i, j, u);
    return { camera, sceneTime: this.#sceneTime(t) };
  }

  /** Cubic Hermite, tangents by the neighbours' difference (Catmull and Rom 1974, uneven times). */
  #spline(i, j, u) {
    const keys = this.keys, h = keys[j].time - keys[i].time, p = k => keys[k].camera.position;
    const tangent = k => {
      const [a, b] = [Math.max(k - 1, 0), Math.min(k + 1, keys.length - 1)];
      const span = Math.max(keys[b].time - keys[a].time, Number.MIN_VALUE);
      return add(p(b), p(a), -1).map(d => (a === b ? 0 : d / span));
    };
    const [ta, tb, u2, u3] = [tangent(i), tangent(j), u * u, u * u * u];
    return [0, 1, 2].map(k => (2 * u3 - 3 * u2 + 1) * p(i)[k] + (u3 - 2 * u2 + u) * h * ta[k]
      + (3 * u2 - 2 * u3) * p(j)[k] + (u3 - u2) * h * tb[k]);
  }

  #sceneTime(t) {
    const told = this.keys.filter(k => k.sceneTime !== null);
    const b = told.find(k => k.time > t), a = told.filter(k => k.time <= t).at(-1);
    return a && b ? lerp(a.sceneTime, b.sceneTime, (t - a.time) / (b.time - a.time)) : (a ?? b)?.sceneTime ?? null;
  }

  toJSON() {
    const tidy = v => v.map(x => +x.toFixed(6));
    return {
      fps: this.fps,
      keys: this.keys.map(({ time, sceneTime, camera }) => ({
        time: +time.toFixed(4), position: tidy(camera.position), look_at: tidy(camera.target),
        // The camera's own up, so that a rolled image stays rolled.
        up: tidy(camera.down.map(x => -x)), fov_y: +camera.fov.toFixed(4),
        ...(sceneTime === null ? {} : { scene_time: +sceneTime.toFixed(6) }),
      })),
    };
  }

  /** From the JSON of a path file; throws an Error whose message names the key and the error. */
  static parse(text, likeness) {
    let value;
    try { value = JSON.parse(text); } catch (e) { throw new Error(`Invalid JSON: ${e.message}.`); }
    const list = value?.keys;
    if (!Array.isArray(list) || !list.length) throw new Error('The list "keys" is missing or empty.');
    const track = new Track();
    if (plain(value.fps) && value.fps >= 0.1 && value.fps <= 1000) track.fps = value.fps;
    list.forEach((key, i) => {
      const wrong = what => { throw new Error(`keys[${i}]: ${what}.`); };
      if (!key || typeof key !== 'object') wrong('not an object');
      const odd = Object.keys(key).find(k => !KEYS.includes(k));
      if (odd) wrong(`unknown key "${odd}"`);
      if (!plain(key.time)) wrong('"time" is missing or not a number');
      if (i && key.time <= track.keys[i - 1].time) wrong('its time is not after that of the previous key');
      track.keys.push({ time: key.time, sceneTime: key.scene_time ?? null, camera: readPose(key, likeness, wrong) });
    });
    return track;
  }

  /** The path that a playback file carries (`path` in its JSON), or null. */
  static fromMeta(list, likeness) {
    if (!Array.isArray(list) || !list.length) return null;
    const keys = list.map(k => ({ time: k.at, position: k.position, look_at: k.target, up: k.up, fov_y: k.fov_y,
      scene_time: k.time }));
    try { return Track.parse(JSON.stringify({ keys }), likeness); } catch { return null; }
  }

  /** Once round the target, for bullet time without a path. */
  static turn(camera) {
    const track = new Track();
    const quarters = 16, target = camera.target;
    for (let k = 0; k <= quarters; k++) {
      const c = camera.clone();
      c.lens = null;
      c.quat = quatMul(quatAbout(camera.up, 2 * Math.PI * k / quarters), camera.quat);
      c.position = add(target, c.forward, -c.distance);
      track.keys.push({ time: TURN * k / quarters, sceneTime: null, camera: c });
    }
    return track;
  }
}

function readPose(key, likeness, wrong) {
  const camera = likeness.clone();
  camera.lens = null;
  const [eye, target] = [vector(key.position), vector(key.look_at)];
  if (key.fov_y != null) {
    if (!plain(key.fov_y) || key.fov_y < 0.1 || key.fov_y > 170) wrong('"fov_y" is not within 0.1 to 170 degrees');
    camera.fov = key.fov_y;
  }
  if (key.scene_time != null && !plain(key.scene_time)) wrong('"scene_time" is not a number');
  if (key.world_to_camera && !key.position && !key.look_at) {
    const m = key.world_to_camera.flat?.(1);
    const matrix = Array.isArray(m) && [12, 16].includes(m.length) && m.every(plain);
    if (!matrix) wrong('"world_to_camera" is not a 3x4 or 4x4 matrix');
    // The rows of camera-from-world are the columns of world-from-camera.
    camera.quat = quatFromRows([0, 1, 2].map(c => [m[c], m[4 + c], m[8 + c]]));
    camera.position = [0, 1, 2].map(c => -(m[c] * m[3] + m[4 + c] * m[7] + m[8 + c] * m[11]));
    return camera;
  }
  if (!eye || !target || key.world_to_camera) wrong('give either "position" and "look_at", or "world_to_camera"');
  if (norm(add(target, eye, -1)) < 1e-9) wrong('position and look_at are the same point');
  const fov = camera.fov;
  camera.look(eye, target, vector(key.up) ?? camera.up);
  camera.fov = fov;
  return camera;
}

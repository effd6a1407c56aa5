// The viewer's camera: position, target, field of view. World axes are the scene's own; camera axes are
// OpenCV's (x right, y down, z forward), as everywhere in splat4d.

export const DEGREE = Math.PI / 180;
/** Near plane where cameras do not state one, scene units. */
export const NEAR = 0.01;
/** Field of view where none is given: that of a normal lens. */
const FOV_DEFAULT = 45;
/** Widest and narrowest image, degrees: wider is a fisheye's business, narrower shows single Gaussians. */
export const FOV_RANGE = [5, 120];
/** In a window taller than the scene was seen, the first view shows this share of its width, so that less of what no camera saw is shown. */
const TALL_SHARE = 0.75;
/** Where the first view is examined for what the capture's cameras saw: shares of the distance to the target, and tangents from its axis. */
const SEEN_AT = [0.5, 0.7, 1, 1.5, 2.2], SEEN_ACROSS = [-0.25, 0, 0.25], SEEN_STEP = 0.02, SEEN_MOST = 2;
/** Cameras that show where a point is; a single one leaves its depth open, and what it alone saw is blurred elsewhere. */
const SEEN_BY = 2;
/** Below this a cross product has no direction: eye, target and up are on one line. */
const PARALLEL = 1e-9;

export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const norm = a => Math.hypot(a[0], a[1], a[2]);
export const normalize = a => { const n = norm(a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
export const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
export const lerp = (a, b, u) => a + (b - a) * u;
const mix = (a, b, u) => a.map((x, i) => lerp(x, b[i], u));

// Quaternions are wxyz.
export const quatNormal = q => { const n = Math.hypot(...q) || 1; return q.map(x => x / n); };
export const quatMul = (a, b) => [
  a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
  a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
  a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
  a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
];
export const quatAbout = (axis, angle) => {
  const s = Math.sin(angle / 2), n = normalize(axis);
  return [Math.cos(angle / 2), n[0] * s, n[1] * s, n[2] * s];
};
/** Rows of the rotation matrix. */
export function quatRows([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}
export const quatTurn = (q, v) => quatRows(q).map(row => dot(row, v));
/** The quaternion of a rotation given by rows; the largest of the four is found first (Shepperd 1978). */
export function quatFromRows(m) {
  const trace = m[0][0] + m[1][1] + m[2][2];
  const squares = [trace, m[0][0], m[1][1], m[2][2]].map((d, i) => (i ? 1 + 2 * d - trace : 1 + trace));
  const i = squares.indexOf(Math.max(...squares));
  const d = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]];
  const s = [m[1][2] + m[2][1], m[0][2] + m[2][0], m[0][1] + m[1][0]];
  const q = [
    [squares[0], d[0], d[1], d[2]], [d[0], squares[1], s[2], s[1]],
    [d[1], s[2], squares[2], s[0]], [d[2], s[1], s[0], squares[3]],
  ][i];
  return quatNormal(q);
}
/** The great arc from a to b (Shoemake 1985), the shorter way; straight where they almost agree. */
export function slerp(a, b, u) {
  let c = a.reduce((sum, x, i) => sum + x * b[i], 0);
  if (c < 0) { b = b.map(x => -x); c = -c; }
  if (c > 1 - 1e-9) return quatNormal(mix(a, b, u));
  const angle = Math.acos(c), s = Math.sin(angle);
  return quatNormal(a.map((x, i) => (Math.sin((1 - u) * angle) * x + Math.sin(u * angle) * b[i]) / s));
}

/** World-from-camera rotation that looks from eye to target, `up` up. */
export function lookRotation(eye, target, up) {
  const z = normalize(add(target, eye, -1));
  let x = cross(z, up);
  if (norm(x) < PARALLEL * (norm(up) || 1)) x = cross(z, Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  x = normalize(x);
  const y = cross(z, x);
  return quatFromRows([0, 1, 2].map(i => [x[i], y[i], z[i]]));
}

/** Any three finite numbers (array, or text "x,y,z"), or null. */
export function vector(value, length = 3) {
  const list = typeof value === 'string' ? value.split(/[\s,]+/).filter(Boolean).map(Number) : value;
  return Array.isArray(list) && list.length === length && list.every(x => typeof x === 'number' && isFinite(x))
    ? list.slice() : null;
}

export class Camera {
  position = [0, 0, -3];
  /** World from camera. */
  quat = [1, 0, 0, 0];
  /** To the point that orbiting turns about, scene units. */
  distance = 3;
  /** Degrees, over the image's shorter side, so that a portrait window shows as much of the subject. */
  fov = FOV_DEFAULT;
  /** The world's up, unit. */
  up = [0, 1, 0];
  /** A dataset camera's exact lens ({width, height, fx, fy, cx, cy} px) until the viewer moves. */
  lens = null;
  /** 1: a first view, which comes nearer in a tall window, until the viewer moves; 0: not; between, in transition. */
  first = 0;
  /** Of a first view: the highest and lowest row that two cameras saw, tangents from its axis, down positive; null: unknown. */
  seen = null;
  /** How far the axis is above the middle of a tall window, tangent; set when a first view is moved. */
  lift = 0;

  get right() { return quatTurn(this.quat, [1, 0, 0]); }
  get down() { return quatTurn(this.quat, [0, 1, 0]); }
  get forward() { return quatTurn(this.quat, [0, 0, 1]); }
  get target() { return add(this.position, this.forward, this.distance); }

  clone() { return Object.assign(new Camera(), { ...this }); }

  set({ position, quat, target, distance, fov, up }) {
    this.lens = null;
    this.first = 0;
    this.lift = 0;
    if (up && norm(up) > PARALLEL) this.up = normalize(up);
    if (position) this.position = position.slice();
    if (quat) this.quat = quatNormal(quat);
    if (target && norm(add(target, this.position, -1)) > PARALLEL) {
      this.distance = norm(add(target, this.position, -1));
      if (!quat) this.quat = lookRotation(this.position, target, this.up);
    }
    if (distance > 0) this.distance = distance;
    if (fov) this.fov = clamp(fov, ...FOV_RANGE);
    return this;
  }

  /** Points at the target with a given up direction, which also may be rolled against the world's. */
  look(position, target, up = this.up) {
    const quat = lookRotation(position, target, up);
    return this.set({ position, quat, distance: norm(add(target, position, -1)) || this.distance });
  }

  /** Between two cameras: u = 0 is a, 1 is b. */
  static between(a, b, u) {
    const c = b.clone();
    if (u >= 1) return c;
    c.lens = null;
    // The target moves straight, so that the target stays in the image.
    const target = mix(a.target, b.target, u);
    c.quat = slerp(a.quat, b.quat, u);
    c.distance = lerp(a.distance, b.distance, u);
    c.position = add(target, c.forward, -c.distance);
    c.fov = lerp(a.fov, b.fov, u);
    c.first = lerp(a.first, b.first, u);
    // The window that these are for is not known here: both are kept, and `view` weighs the first one.
    c.seen = a.first ? a.seen : b.seen;
    c.lift = lerp(a.lift, b.lift, u);
    return c;
  }

  /** The contract's view, for a drawing buffer of width x height px. */
  view(width, height) {
    const rows = quatRows(this.quat), p = this.position;
    const out = new Float64Array(12);
    for (let i = 0; i < 3; i++) {
      const row = [rows[0][i], rows[1][i], rows[2][i]];
      out.set([...row, -dot(row, p)], 4 * i);
    }
    const view = { cameraFromWorld: out, width, height };
    if (this.lens) {
      // All of the dataset camera's image is shown, centred, with more of the world where the window is wider.
      const l = this.lens, k = Math.min(width / l.width, height / l.height) * this.#nearer(width / l.width, height / l.height);
      const cy = height / 2 + (l.cy - l.height / 2) * k - this.#lifted(width, height, l.fy * k) * l.fy * k;
      return { ...view, fx: l.fx * k, fy: l.fy * k, cx: width / 2 + (l.cx - l.width / 2) * k, cy };
    }
    const f = Math.min(width, height) / 2 / Math.tan(this.fov * DEGREE / 2) * this.#nearer(width, height);
    return { ...view, fx: f, fy: f, cx: width / 2, cy: height / 2 - this.#lifted(width, height, f) * f };
  }

  /** How far the axis is above the middle of the window, tangent: a tall one shows as little as possible of what no camera saw. */
  #lifted(width, height, f) {
    if (height <= width) return 0;
    if (!this.first || !this.seen) return this.lift;
    const half = height / 2 / f, [top, bottom] = this.seen;
    const first = top + half > bottom - half ? (top + bottom) / 2 : clamp(0, top + half, bottom - half);
    // The subject stays in the middle half.
    return lerp(this.lift, clamp(first, -half / 2, half / 2), this.first);
  }

  /** How much larger a first view is where the window is taller than wide, each measured in what was seen. */
  #nearer(across, down) { return clamp(down / across, 1, 1 / TALL_SHARE) ** this.first; }

  /** Turns an exact lens and a first view into a field of view, before a movement. */
  loosen(width, height) {
    if (!this.lens && !this.first) return;
    const { fy } = this.view(width, height);
    this.lift = this.#lifted(width, height, fy);
    this.lens = null;
    this.first = 0;
    this.fov = clamp(2 * Math.atan(Math.min(width, height) / 2 / fy) / DEGREE, ...FOV_RANGE);
  }

  toJSON() {
    return { position: this.position, quat: this.quat, target: this.target, fov: this.fov };
  }
}

/** The scene's box {center, radius}; a unit ball where the file states none. */
export function bounds(meta) {
  const box = meta?.box;
  const low = vector(box?.[0]), high = vector(box?.[1]);
  if (!low || !high) return { center: [0, 0, 0], radius: 1 };
  return { center: mix(low, high, 0.5), radius: Math.max(norm(add(high, low, -1)) / 2, 1e-6) };
}

/** The first view: the file's own, else its first dataset camera, else the whole box from the front. */
export const firstCamera = meta => {
  const camera = viewpoint(meta);
  return Object.assign(camera, { first: 1, seen: seenRows(camera, meta?.cameras ?? []) });
};

/** The highest and lowest row of a view in which two cameras of the capture saw something, tangents from its axis; null: there are no two cameras. */
function seenRows(camera, cameras) {
  if (cameras.length < SEEN_BY) return null;
  const { position, right, down, forward, distance } = camera;
  const sees = (c, p) => {
    const m = c.world_from_camera, d = [p[0] - m[3], p[1] - m[7], p[2] - m[11]];
    const [x, y, z] = [0, 1, 2].map(k => m[k] * d[0] + m[4 + k] * d[1] + m[8 + k] * d[2]);
    const u = c.fx * x / z + c.cx, v = c.fy * y / z + c.cy;
    return z > 0 && u >= 0 && v >= 0 && u <= c.width && v <= c.height;
  };
  const isSeen = row => SEEN_AT.some(share => SEEN_ACROSS.every(x => {
    const ray = add(add(forward, right, x), down, row), p = add(position, ray, share * distance);
    return cameras.filter(c => sees(c, p)).length >= SEEN_BY;
  }));
  const end = sign => {
    let row = 0;
    while (Math.abs(row) < SEEN_MOST && isSeen(row + sign * SEEN_STEP)) row += sign * SEEN_STEP;
    return row;
  };
  return [end(-1), end(1)];
}

function viewpoint(meta) {
  const camera = new Camera();
  const { center, radius } = bounds(meta);
  camera.up = normalize(vector(meta?.up) ?? [0, 1, 0]);
  const view = meta?.view;
  if (vector(view?.position) && vector(view?.target)) {
    return camera.look(view.position, view.target, vector(view.up) ?? camera.up).set({ fov: view.fov_y });
  }
  if (meta?.cameras?.length) return datasetCamera(meta, meta.cameras[0]);
  const side = Math.abs(camera.up[2]) < 0.9 ? [0, 0, 1] : [0, -1, 0];
  // 2.6 radii away a ball of one radius fills a field of 45 degrees.
  return camera.look(add(center, side, 2.6 * radius), center);
}

/** One of the capture's cameras; orbiting turns about the point of its axis nearest to the scene's middle. */
export function datasetCamera(meta, entry) {
  const m = entry.world_from_camera;
  const camera = new Camera();
  const { center, radius } = bounds(meta);
  camera.up = normalize(vector(meta.up) ?? [0, 1, 0]);
  const quat = quatFromRows([0, 4, 8].map(i => m.slice(i, i + 3)));
  const position = [m[3], m[7], m[11]];
  camera.set({ position, quat });
  const ahead = dot(add(center, position, -1), camera.forward);
  camera.distance = ahead > 0.05 * radius ? ahead : radius;
  const half = Math.min(entry.height / entry.fy, entry.width / entry.fx) / 2;
  camera.fov = clamp(2 * Math.atan(half) / DEGREE, ...FOV_RANGE);
  camera.lens = { width: entry.width, height: entry.height, fx: entry.fx, fy: entry.fy, cx: entry.cx, cy: entry.cy };
  return camera;
}

/** A camera's time offset against the first one, in words; null: none. */
export const clockOf = camera => (Number.isFinite(camera.offset)
  ? `clock ${camera.offset > 0 ? '+' : '−'}${Math.abs(1000 * camera.offset).toFixed(1)} ms` : null);

// Deep links: the part of an address behind '#'.

const short = x => String(+x.toPrecision(6));

/** {camera, time, channel, playing} as 'p=…&q=…&d=…&fov=…&t=…&ch=…&play=1'. */
export function linkText({ camera, time, channel, playing }) {
  const parts = [
    'p=' + camera.position.map(short), 'q=' + camera.quat.map(short), 'd=' + short(camera.distance),
    'fov=' + short(camera.fov), 't=' + short(time),
  ];
  if (channel !== 'color') parts.push('ch=' + channel);
  if (playing) parts.push('play=1');
  return parts.join('&');
}

/** What a link states, and only that; nonsense is left out. A link may hold `target` in place of `q` and `d`. */
export function readLink(text) {
  const given = new URLSearchParams(text.replace(/^#/, ''));
  const number = key => {
    const x = given.get(key);
    return x !== null && x !== '' && isFinite(x) ? Number(x) : undefined;
  };
  const out = {};
  const position = vector(given.get('p'));
  const quat = vector(given.get('q'), 4), target = vector(given.get('target'));
  if (position && ((quat && Math.hypot(...quat) > PARALLEL) || target)) {
    out.camera = { position, ...(quat ? { quat } : { target }), distance: number('d') };
  }
  if (number('fov')) out.camera = { ...out.camera, fov: number('fov') };
  if (number('t') !== undefined) out.time = number('t');
  if (given.get('ch')) out.channel = given.get('ch');
  if (given.has('play')) out.playing = given.get('play') !== '0';
  return out;
}

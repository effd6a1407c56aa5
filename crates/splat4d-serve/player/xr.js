// Immersive viewing, with the WebGL2 backend, which draws each eye straight into the headset's image. Tested: that no
// button shows where no headset is offered, the mathematics of an eye's view, and a session of a simulated headset.
// Never tested for lack of a device: a real headset, its frame rate, and how the order by depth, which WebGL2 computed
// for the head of some frames ago, appears while the head turns. Both eyes show the same time: eyes with parallel axes have
// one order, which is exact for both, canted ones get an order each (schedule.js).

import { add, bounds, quatMul, quatNormal, quatRows, quatTurn } from './camera.js';
import { Fovea } from './fovea.js';

/** A scene that states no unit is shown this large, metres from its middle: a dolls' house on a table. */
const TABLE_RADIUS = 0.6;

/** WebXR's axes (x right, y up, z back) are ours turned half about x. */
const FLIP = [0, 1, 0, 0];

/** The contract's view of an eye; `start` is the camera that the headset's origin represents, `unit` metres a unit. */
export function eyeView(eye, start, unit, width, height) {
  const { position: p, orientation: o } = eye.transform;
  // Headset origin → world: the starting camera's pose; the eye's own pose is relative to it, in metres.
  const turn = quatMul(start.quat, FLIP);
  const quat = quatNormal(quatMul(turn, quatMul([o.w, o.x, o.y, o.z], FLIP.map((x, i) => (i ? -x : x)))));
  const position = add(start.position, quatTurn(turn, [p.x, p.y, p.z].map(x => x / unit)));
  const rows = quatRows(quat), out = new Float64Array(12);
  for (let i = 0; i < 3; i++) {
    const row = [rows[0][i], rows[1][i], rows[2][i]];
    out.set([...row, -(row[0] * position[0] + row[1] * position[1] + row[2] * position[2])], 4 * i);
  }
  const P = eye.projectionMatrix;
  return { cameraFromWorld: out, width, height, fx: P[0] * width / 2, fy: P[5] * height / 2,
    cx: (1 - P[8]) * width / 2, cy: (1 + P[9]) * height / 2 };
}

/** Where a device does not report its floor, this far below it, metres: it is held before a standing person. */
const FLOOR = -1.4;
/** Frames per second of headsets that do not state them. */
const RATE = 72;
/** Initial distance of a scene in the room, metres. */
const AHEAD = 1.2;

/** A scene on the floor of the room: `start`, which the headset's origin represents, is moved onto it. */
class Standing {
  #start;
  #unit;
  #foot;
  #floor;
  placed = false;

  constructor(start, unit, meta, floor) {
    const { center } = bounds(meta), [low, high] = meta.box ?? [center, center];
    // Half of the box along what is up.
    const half = start.up.reduce((sum, u, k) => sum + Math.abs(u) * (high[k] - low[k]) / 2, 0);
    this.#foot = add(center, start.up, -half);
    [this.#start, this.#unit, this.#floor] = [start, unit, floor];
  }

  /** Puts the middle of its foot on the floor, at x and z of the headset's space, metres. */
  put(x, z) {
    const turn = quatMul(this.#start.quat, FLIP);
    this.#start.position = add(this.#foot, quatTurn(turn, [x, this.#floor, z].map(v => v / this.#unit)), -1);
    this.placed = true;
  }

  /** Ahead of a viewer. */
  ahead({ position: p, orientation: o }) {
    const [x, , z] = quatTurn([o.w, o.x, o.y, o.z], [0, 0, -1]), far = Math.hypot(x, z) || 1;
    this.put(p.x + AHEAD * x / far, p.z + AHEAD * z / far);
  }

  /** Where a ray meets the floor; nowhere: it stays. */
  tap({ position: p, orientation: o }) {
    const [x, y, z] = quatTurn([o.w, o.x, o.y, o.z], [0, 0, -1]), way = (this.#floor - p.y) / y;
    if (way > 0 && isFinite(way)) this.put(p.x + way * x, p.z + way * z);
  }
}

/**
 * Runs a session on the player; resolves when it has ended. `mode`: 'immersive-vr', where the viewer is in the scene, or
 * 'immersive-ar', where the scene is in the room and a tap on the floor puts it there.
 */
export async function enter(player, mode = 'immersive-vr') {
  const ar = mode === 'immersive-ar';
  const session = await navigator.xr.requestSession(mode, ar ? { optionalFeatures: ['local-floor'] } : {});
  if (player.backend?.name !== 'webgl2') await player.useBackend('webgl2');
  const { gl } = player.backend;
  await gl.makeXRCompatible();
  const layer = new XRWebGLLayer(session, gl, { antialias: false, alpha: ar });
  await session.updateRenderState({ baseLayer: layer });
  const floor = ar && await session.requestReferenceSpace('local-floor').catch(() => null);
  const space = floor || await session.requestReferenceSpace('local');
  const start = player.camera.clone(), { radius } = bounds(player.meta);
  // The headset's horizon is level: only the heading of the page's camera is kept.
  const ahead = add(start.forward, start.up, -start.forward.reduce((s, x, i) => s + x * start.up[i], 0));
  start.look(start.position, add(start.position, ahead));
  const unit = player.meta.unit ?? TABLE_RADIUS / radius;
  const standing = ar ? new Standing(start, unit, player.meta, floor ? 0 : FLOOR) : null;
  session.addEventListener('select', ({ frame, inputSource }) => {
    const ray = frame.getPose(inputSource.targetRaySpace, space);
    if (ray) standing?.tap(ray.transform);
  });
  player.immersed = true;
  let last = 0, fovea = new Fovea(player);
  const tick = (now, frame) => {
    session.requestAnimationFrame(tick);
    player.advance(Math.min((now - last) / 1000, 0.1));
    // A headset that misses two of three frames is too slow: it thins the edges, then drops a rung. Fewer pixels are not
    // tried there.
    const period = 1000 / (session.frameRate || RATE), limits = { slow: 1.5 * period, fast: 1.15 * period };
    if (fovea.file !== player.file) fovea = new Fovea(player);
    if (last) player.frameTook(now - last, now, fovea.frame(now - last, now, player.ladder, limits));
    last = now;
    // Null where the layer offers none. It coarsens only the copy to the headset: splats are blended before it.
    if (layer.fixedFoveation != null) layer.fixedFoveation = fovea.strength;
    const viewer = frame.getViewerPose(space);
    if (viewer && standing && !standing.placed) standing.ahead(viewer.transform);
    const ports = (viewer?.views ?? []).map(eye => layer.getViewport(eye));
    const eyes = ports.map(({ width, height }, k) => eyeView(viewer.views[k], start, unit, width, height));
    ports.forEach(({ x, y, width, height }, eye) => {
      const drawing = player.drawing(width, height);
      if (ar) drawing.background = null;
      player.backend.draw({ ...drawing, view: eyes[eye], eyes, eye, fovea: fovea.edge, target: { framebuffer: layer.framebuffer, x, y } });
    });
  };
  session.requestAnimationFrame(tick);
  await new Promise(done => session.addEventListener('end', done));
  player.immersed = false;
}

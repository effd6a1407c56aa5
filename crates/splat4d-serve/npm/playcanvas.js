// A dynamic scene of Gaussians in PlayCanvas' engine: `app.root.addChild(new Splat4D(app, 'scene.s4d').entity)`, and
// `object.update(camera)` before each frame. The engine sorts and renders it together with its other splats; motion and
// colours are evaluated on the CPU.

import {
  Entity, GSplatContainer, GSplatFormat, Mat4, PIXELFORMAT_RGBA32F, Quat, Vec3, WORKBUFFER_UPDATE_ONCE,
} from 'playcanvas';
import { AXES, Feed } from './engine.js';
import { LOW_PASS } from './player/constants.js';

const STREAMS = ['dataCenter', 'dataColor', 'dataScale', 'dataRotation'];
/// What the engine's shaders call for a Gaussian's numbers.
const READ_GLSL = `
vec3 getCenter() { return loadDataCenter().xyz; }
vec4 getColor() { return loadDataColor(); }
vec3 getScale() { return loadDataScale().xyz; }
vec4 getRotation() { return loadDataRotation(); }`;
const READ_WGSL = `
fn getCenter() -> vec3f { return loadDataCenter().xyz; }
fn getColor() -> vec4f { return loadDataColor(); }
fn getScale() -> vec3f { return loadDataScale().xyz; }
fn getRotation() -> vec4f { return loadDataRotation(); }`;
/// The engine's kernel is exp(−d²/2), lowered so that it ends at 0 where d² = 8 (gsplatPS). A Gaussian of this many
/// times the variance has the same area there.
const EDGE = Math.exp(-4),
  WIDER = 1 / (1 - (4 * EDGE) / (1 - EDGE));
/// Variance that the engine adds in the image, px²: its shader adds 0.3 at twice the focal length (gsplatCornerVS).
const ENGINE_LOW_PASS = 0.3 / 4;
/// What is missing of the player's.
const MISSING = LOW_PASS * WIDER - ENGINE_LOW_PASS;

const numbers = ({ x, y, z }) => [x, y, z];

export class Splat4D {
  /// The clock and the file: `frames.time`, `play()`, `pause()`, `loop`, `speed`, `meta`.
  frames;
  /// A promise: the index is read. Rejects where there is no such file, or it is damaged.
  ready;
  /// The entity to place in the scene. Its child holds the Gaussians in the file's axes.
  entity = new Entity('splat4d');
  #feed;
  #device;
  #child = new Entity('splat4d file axes');
  #container = null;
  #gone = false;

  /// `source`: an address, File, Blob or ArrayBuffer. `up`: the entity's axis ('x', 'y', 'z') that points up as the
  /// file's up does; null keeps the file's axes. `budget`: bytes of pages that stay in memory. `onchange()`: pages
  /// came. `onerror(error)`: pages cannot be read.
  constructor(app, source, { up = 'y', ...options } = {}) {
    this.#device = app.graphicsDevice;
    this.entity.addChild(this.#child);
    this.#feed = new Feed(source, options);
    this.frames = this.#feed.frames;
    this.ready = this.frames.ready.then(() => {
      if (this.#gone) return;
      const { meta, capacity } = this.frames;
      const streams = STREAMS.map((name) => ({ name, format: PIXELFORMAT_RGBA32F }));
      const format = new GSplatFormat(this.#device, streams, { readGLSL: READ_GLSL, readWGSL: READ_WGSL });
      this.#container = new GSplatContainer(this.#device, Math.max(capacity, 1), format);
      if (up) this.#child.setLocalRotation(new Quat().setFromDirections(new Vec3(meta.up).normalize(), new Vec3(AXES[up])));
      this.#child.addComponent('gsplat', { resource: this.#container });
    });
    this.ready.catch(() => {});
  }

  /// Moves the clock and gives the engine the Gaussians of its time, with the colours that the entity `camera` sees.
  /// Call it before each frame: `app.on('update', () => object.update(camera))`.
  update(camera, now = performance.now()) {
    const container = this.#container;
    if (!container) return;
    const fileFromWorld = new Mat4().copy(this.#child.getWorldTransform()).invert();
    const eye = numbers(fileFromWorld.transformPoint(camera.getPosition())),
      forward = numbers(fileFromWorld.transformVector(camera.forward).normalize());
    const { renderTarget, rect, projectionMatrix } = camera.camera;
    // The focal length, px.
    const focal = (projectionMatrix.data[5] * rect.w * (renderTarget ?? this.#device).height) / 2;
    const arrays = this.#feed.next([...eye, ...forward, focal], now);
    if (!arrays) return;
    const { count, position, rotation, scale, opacity, color } = arrays;
    const textures = STREAMS.map((name) => container.getTexture(name)),
      low = [Infinity, Infinity, Infinity],
      high = [-Infinity, -Infinity, -Infinity];
    const [centers, colors, scales, rotations] = textures.map((t) => t.lock());
    for (let i = 0, a = 0, b = 0; i < this.frames.capacity; i++, a += 3, b += 4) {
      colors[b + 3] = opacity[i];
      if (i >= count) continue;
      let depth = 0;
      for (let k = 0; k < 3; k++) {
        depth += forward[k] * (position[a + k] - eye[k]);
        low[k] = Math.min(low[k], position[a + k]);
        high[k] = Math.max(high[k], position[a + k]);
      }
      // A ball's image has the variance (focal/depth)² times its own.
      const more = MISSING * (depth / focal) ** 2;
      for (let k = 0; k < 3; k++) {
        centers[b + k] = position[a + k];
        colors[b + k] = color[a + k];
        scales[b + k] = Math.sqrt(WIDER * scale[a + k] ** 2 + more);
      }
      // The engine stores the real part first.
      rotations[b] = rotation[b + 3];
      rotations[b + 1] = rotation[b];
      rotations[b + 2] = rotation[b + 1];
      rotations[b + 3] = rotation[b + 2];
    }
    for (const texture of textures) texture.unlock();
    // The engine leaves out what lies outside of the box. Unused rows lie within it.
    if (count) container.aabb.setMinMax(new Vec3(low), new Vec3(high));
    container.centers.set(position);
    for (let i = count; count && i < this.frames.capacity; i++) container.centers.set(position.subarray(0, 3), 3 * i);
    container.update();
    // Otherwise the engine, whose counts did not change, sorts the new centres and continues rendering the former
    // Gaussians.
    this.#child.gsplat.workBufferUpdate = WORKBUFFER_UPDATE_ONCE;
  }

  /// Sets the clock and resolves when the pages of that time are there; the next `update` shows it. Rejects where they
  /// cannot be read.
  async load(time) {
    await this.#feed.load(time);
    await this.ready;
  }

  destroy() {
    this.#gone = true;
    this.frames.dispose();
    this.entity.destroy();
    this.#container?.destroy();
    this.#container = null;
  }
}

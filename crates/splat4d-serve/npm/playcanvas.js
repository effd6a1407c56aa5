// A dynamic scene of Gaussians in PlayCanvas' engine: `app.root.addChild(new Splat4D(app, 'scene.s4d').entity)`, and
// `take.update(camera)` before each frame. The engine sorts and renders it together with its other splats; motion and colours are
// evaluated on the CPU.

import { Entity, GSplatContainer, GSplatFormat, Mat4, PIXELFORMAT_RGBA32F, Quat, Vec3 } from 'playcanvas';
import { Frames } from './frames.js';

const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };
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

export class Splat4D {
  /// The clock and the file: `frames.time`, `play()`, `pause()`, `loop`, `speed`, `meta`.
  frames;
  /// A promise: the index is read. Rejects where there is no such file, or it is damaged.
  ready;
  /// The entity to place in the scene. Its child holds the Gaussians in the file's axes.
  entity = new Entity('splat4d');
  #child = new Entity('splat4d file axes');
  #container = null;
  #changed = true;
  #shown = { time: NaN, eye: null, forward: null };

  /// `source`: an address, File, Blob or ArrayBuffer. `up`: the entity's axis ('x', 'y', 'z') that points up as the file's up
  /// does; null keeps the file's axes. `budget`: bytes of pages that stay in memory.
  constructor(app, source, { up = 'y', budget, onchange = () => {} } = {}) {
    const changed = () => ((this.#changed = true), onchange());
    this.entity.addChild(this.#child);
    this.frames = new Frames(source, { budget, onchange: changed });
    this.ready = this.frames.ready.then(() => {
      const { meta, capacity } = this.frames;
      if (!meta) return;
      const format = new GSplatFormat(
        app.graphicsDevice,
        STREAMS.map((name) => ({ name, format: PIXELFORMAT_RGBA32F })),
        { readGLSL: READ_GLSL, readWGSL: READ_WGSL },
      );
      this.#container = new GSplatContainer(app.graphicsDevice, Math.max(capacity, 1), format);
      const [low, high] = meta.box ?? [[-1, -1, -1], [1, 1, 1]];
      // A Gaussian reaches beyond its mean.
      const reach = Math.max(...high.map((x, k) => x - low[k])) || 1;
      this.#container.aabb.setMinMax(new Vec3(low).sub(new Vec3(reach, reach, reach)), new Vec3(high).add(new Vec3(reach, reach, reach)));
      if (up) this.#child.setLocalRotation(new Quat().setFromDirections(new Vec3(meta.up).normalize(), new Vec3(AXES[up])));
      this.#container.update(0);
      this.#child.addComponent('gsplat', { resource: this.#container });
    });
    this.ready.catch(() => {});
  }

  /// Moves the clock and gives the engine the Gaussians of its time, with the colours that the entity `camera` sees. Call it before
  /// each frame: `app.on('update', () => take.update(camera))`.
  update(camera, now = performance.now()) {
    if (!this.#container) return;
    const { frames } = this;
    frames.tick(now);
    const fileFromWorld = new Mat4().copy(this.#child.getWorldTransform()).invert();
    const eye = fileFromWorld.transformPoint(camera.getPosition()),
      forward = fileFromWorld.transformVector(camera.forward).normalize();
    const { time, eye: before, forward: ahead } = this.#shown;
    if (!this.#changed && frames.time === time && eye.equals(before) && forward.equals(ahead)) return;
    this.#changed = false;
    this.#shown = { time: frames.time, eye, forward };
    const numbers = ({ x, y, z }) => [x, y, z];
    const { count, position, rotation, scale, opacity, color } = frames.at(frames.time, numbers(eye), numbers(forward));
    const textures = STREAMS.map((name) => this.#container.getTexture(name));
    const [centers, colors, scales, rotations] = textures.map((t) => t.lock());
    for (let i = 0, a = 0, b = 0; i < count; i++, a += 3, b += 4) {
      for (let k = 0; k < 3; k++) {
        centers[b + k] = position[a + k];
        colors[b + k] = color[a + k];
        scales[b + k] = scale[a + k];
      }
      colors[b + 3] = opacity[i];
      // The engine stores the real part first.
      rotations[b] = rotation[b + 3];
      rotations[b + 1] = rotation[b];
      rotations[b + 2] = rotation[b + 1];
      rotations[b + 3] = rotation[b + 2];
    }
    for (const texture of textures) texture.unlock();
    this.#container.centers.set(position.subarray(0, 3 * count));
    this.#container.update(count);
  }

  /// Sets the clock and resolves when the pages of that time are there; the next `update` shows it.
  async load(time) {
    await this.frames.load(time);
    await this.ready;
    this.#changed = true;
  }

  destroy() {
    this.frames.dispose();
    this.entity.destroy();
    this.#container?.destroy();
  }
}

// A dynamic scene of Gaussians in Spark (three.js): `scene.add(new Splat4D('scene.s4d'))`, and `object.update(camera)`
// before each frame. Spark sorts and renders it together with its other splats; motion and colours are evaluated on the
// CPU.

import * as THREE from 'three';
import { ExtSplats, SplatMesh, utils } from '@sparkjsdev/spark';
import { AXES, Feed } from './engine.js';
import { ALPHA_SPAN, LOW_PASS } from './player/constants.js';

/// Settings of Spark's renderer with which it renders as the player does:
/// `new SparkRenderer({ renderer, ...SETTINGS })`. By default, Spark assumes models that were trained with an
/// antialiasing filter: it widens Gaussians and lowers their opacity.
export const SETTINGS = {
  preBlurAmount: LOW_PASS, blurAmount: 0, maxStdDev: ALPHA_SPAN, minAlpha: 1 / 255, sortRadial: false, accumExtSplats: true,
};
/// 32-bit words of a Gaussian in each of Spark's two arrays.
const WORDS = 4;

export class Splat4D extends THREE.Object3D {
  isSplat4D = true;
  /// The clock and the file: `frames.time`, `play()`, `pause()`, `loop`, `speed`, `meta`.
  frames;
  /// A promise: the index is read. Rejects where there is no such file, or it is damaged.
  ready;
  /// Spark's object with the current Gaussians, in the file's axes; null until `ready`.
  mesh = null;
  #feed;
  #splats = null;
  #gone = false;

  /// `source`: an address, File, Blob or ArrayBuffer. `up`: the object's axis ('x', 'y', 'z') that points up as the
  /// file's up does; null keeps the file's axes. `budget`: bytes of pages that stay in memory. `onchange()`: pages
  /// arrived.
  /// `onerror(error)`: pages cannot be read.
  constructor(source, { up = 'y', ...options } = {}) {
    super();
    this.#feed = new Feed(source, options);
    this.frames = this.#feed.frames;
    this.ready = this.frames.ready.then(() => {
      if (this.#gone) return;
      const { meta, capacity } = this.frames;
      const room = WORDS * utils.getTextureSize(Math.max(capacity, 1)).maxSplats;
      this.#splats = new ExtSplats({ extArrays: [new Uint32Array(room), new Uint32Array(room)], numSplats: capacity });
      this.mesh = new SplatMesh({ extSplats: this.#splats, raycastable: false, editable: false });
      if (up) this.mesh.quaternion.setFromUnitVectors(new THREE.Vector3(...meta.up).normalize(), new THREE.Vector3(...AXES[up]));
      this.add(this.mesh);
    });
    this.ready.catch(() => {});
  }

  /// Moves the clock and gives Spark the Gaussians of its time, with the colours that `camera` sees. Call it before
  /// each frame.
  update(camera, now = performance.now()) {
    const { mesh } = this;
    if (!mesh) return;
    camera.updateWorldMatrix(true, false);
    mesh.updateWorldMatrix(true, false);
    const eye = mesh.worldToLocal(new THREE.Vector3().setFromMatrixPosition(camera.matrixWorld)),
      forward = camera.getWorldDirection(new THREE.Vector3()).transformDirection(mesh.matrixWorld.clone().invert());
    const arrays = this.#feed.next([...eye.toArray(), ...forward.toArray()], now);
    if (!arrays) return;
    const { position, rotation, scale, opacity, color } = arrays,
      { extArrays, textures } = this.#splats;
    for (let i = 0; i < this.frames.capacity; i++) {
      const [a, b] = [3 * i, 4 * i];
      utils.encodeExtSplat(
        extArrays, i, position[a], position[a + 1], position[a + 2], scale[a], scale[a + 1], scale[a + 2],
        rotation[b], rotation[b + 1], rotation[b + 2], rotation[b + 3], opacity[i], color[a], color[a + 1], color[a + 2],
      );
    }
    for (const texture of textures) texture.needsUpdate = true;
    // Spark shows them once their order is there; a version without a new mapping would be shown in the order of
    // another time.
    mesh.updateMappingVersion();
  }

  /// Sets the clock and resolves when the pages of that time are there; the next `update` shows it. Rejects where they
  /// cannot be read.
  async load(time) {
    await this.#feed.load(time);
    await this.ready;
  }

  dispose() {
    this.#gone = true;
    this.frames.dispose();
    this.mesh?.dispose();
    this.mesh = this.#splats = null;
    this.removeFromParent();
  }
}

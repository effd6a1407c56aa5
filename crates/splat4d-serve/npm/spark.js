// A dynamic scene of Gaussians in Spark (three.js): `scene.add(new Splat4D('scene.s4d'))`, and `take.update(camera)` before each
// frame. Spark sorts and renders it together with its other splats; motion and colours are evaluated on the CPU.

import * as THREE from 'three';
import { ExtSplats, SplatMesh, utils } from '@sparkjsdev/spark';
import { Frames } from './frames.js';

const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };

export class Splat4D extends THREE.Object3D {
  isSplat4D = true;
  /// The clock and the file: `frames.time`, `play()`, `pause()`, `loop`, `speed`, `meta`.
  frames;
  /// A promise: the index is read. Rejects where there is no such file, or it is damaged.
  ready;
  /// Spark's object with this moment's Gaussians, in the file's axes; null until `ready`.
  mesh = null;
  #splats = null;
  #changed = true;
  #shown = { time: NaN, eye: null, forward: null };

  /// `source`: an address, File, Blob or ArrayBuffer. `up`: the object's axis ('x', 'y', 'z') that points up as the file's up
  /// does; null keeps the file's axes. `budget`: bytes of pages that stay in memory.
  constructor(source, { up = 'y', budget, onchange = () => {} } = {}) {
    super();
    const changed = () => ((this.#changed = true), onchange());
    this.frames = new Frames(source, { budget, onchange: changed });
    this.ready = this.frames.ready.then(() => {
      const { meta, capacity } = this.frames;
      if (!meta) return;
      const room = 4 * utils.getTextureSize(Math.max(capacity, 1)).maxSplats;
      this.#splats = new ExtSplats({ extArrays: [new Uint32Array(room), new Uint32Array(room)], numSplats: 0 });
      this.mesh = new SplatMesh({ extSplats: this.#splats, raycastable: false, editable: false });
      if (up) this.mesh.quaternion.setFromUnitVectors(new THREE.Vector3(...meta.up).normalize(), new THREE.Vector3(...AXES[up]));
      this.add(this.mesh);
    });
    this.ready.catch(() => {});
  }

  /// Moves the clock and gives Spark the Gaussians of its time, with the colours that `camera` sees. Call it before each frame.
  update(camera, now = performance.now()) {
    if (!this.mesh) return;
    const { frames, mesh } = this;
    frames.tick(now);
    camera.updateWorldMatrix(true, false);
    mesh.updateWorldMatrix(true, false);
    const eye = mesh.worldToLocal(new THREE.Vector3().setFromMatrixPosition(camera.matrixWorld)),
      forward = camera.getWorldDirection(new THREE.Vector3()).transformDirection(mesh.matrixWorld.clone().invert());
    const { time, eye: before, forward: ahead } = this.#shown;
    if (!this.#changed && frames.time === time && eye.equals(before) && forward.equals(ahead)) return;
    this.#changed = false;
    this.#shown = { time: frames.time, eye, forward };
    const { count, position, rotation, scale, opacity, color } = frames.at(frames.time, eye.toArray(), forward.toArray());
    for (let i = 0; i < count; i++) {
      const [a, b] = [3 * i, 4 * i];
      utils.encodeExtSplat(
        this.#splats.extArrays, i, position[a], position[a + 1], position[a + 2], scale[a], scale[a + 1], scale[a + 2],
        rotation[b], rotation[b + 1], rotation[b + 2], rotation[b + 3], opacity[i], color[a], color[a + 1], color[a + 2],
      );
    }
    for (const texture of this.#splats.textures) texture.needsUpdate = true;
    this.#splats.numSplats = mesh.numSplats = count;
    mesh.updateMappingVersion();
  }

  /// Sets the clock and resolves when the pages of that time are there; the next `update` shows it.
  async load(time) {
    await this.frames.load(time);
    await this.ready;
    this.#changed = true;
  }

  dispose() {
    this.frames.dispose();
    this.mesh?.dispose();
    this.removeFromParent();
  }
}

// A dynamic scene of Gaussians in Babylon.js: `const object = new Splat4D('scene.s4d', scene)`; it follows the scene's
// active camera on its own. Babylon.js sorts and renders it; motion and colours are evaluated on the CPU. Its interface
// takes rotations and colours in bytes.

import { GaussianSplattingMesh, Matrix, Quaternion, TransformNode, Vector3 } from '@babylonjs/core';
import { AXES, Feed } from './engine.js';
import { LOW_PASS } from './player/constants.js';

/// Bytes of a Gaussian in the layout that `updateData` takes: position and scale as f32, colour and opacity, rotation w
/// x y z.
const ROW = 32;
/// The shader adds `kernelSize` to variances of an image of twice the size (gaussianSplatting.fx).
const KERNEL = 4 * LOW_PASS;

export class Splat4D {
  /// The clock and the file: `frames.time`, `play()`, `pause()`, `loop`, `speed`, `meta`.
  frames;
  /// A promise: the index is read. Rejects where there is no such file, or it is damaged.
  ready;
  /// The node to place in the scene.
  node;
  /// Babylon's mesh with the current Gaussians, in the file's axes; null until `ready`.
  mesh = null;
  #scene;
  #feed;
  #observer = null;
  #bytes = null;
  /// Babylon.js has data to sort.
  #given = false;
  #gone = false;

  /// `source`: an address, File, Blob or ArrayBuffer. `up`: the node's axis ('x', 'y', 'z') that points up as the
  /// file's up does; null keeps the file's axes. In a left-handed scene, the default of Babylon.js, z is mirrored.
  /// `budget`: bytes of pages that stay in memory. `onchange()`: pages arrived. `onerror(error)`: pages cannot be read.
  constructor(source, scene, { up = 'y', ...options } = {}) {
    this.#scene = scene;
    this.node = new TransformNode('splat4d', scene);
    this.#feed = new Feed(source, options);
    this.frames = this.#feed.frames;
    this.ready = this.frames.ready.then(() => {
      if (this.#gone) return;
      const { meta, capacity } = this.frames;
      const hand = new TransformNode('splat4d handedness', scene);
      hand.parent = this.node;
      if (!scene.useRightHandedSystem) hand.scaling.z = -1;
      this.mesh = new GaussianSplattingMesh('splat4d file axes', null, scene);
      this.mesh.material.kernelSize = KERNEL;
      this.mesh.material.compensation = false;
      this.mesh.parent = hand;
      this.#bytes = new Uint8Array(ROW * Math.max(capacity, 1));
      if (up) {
        const turn = new Quaternion();
        Quaternion.FromUnitVectorsToRef(Vector3.FromArray(meta.up).normalize(), Vector3.FromArray(AXES[up]), turn);
        this.mesh.rotationQuaternion = turn;
      }
      this.#observer = scene.onBeforeRenderObservable.add(() => this.update());
    });
    this.ready.catch(() => {});
  }

  /// Moves the clock and gives Babylon.js the Gaussians of its time, with the colours that the camera sees. Each frame
  /// of the scene calls it.
  update(camera = this.#scene.activeCamera, now = performance.now()) {
    const { mesh } = this;
    if (!mesh || !camera) return;
    // A sort that was requested before new data came would show them in the order of another time.
    if (this.#given && mesh._isDepthSortSettled === false) return;
    const fileFromWorld = Matrix.Invert(mesh.computeWorldMatrix(true));
    const eye = Vector3.TransformCoordinates(camera.globalPosition, fileFromWorld),
      forward = Vector3.TransformNormal(camera.getForwardRay(1).direction, fileFromWorld).normalize();
    const arrays = this.#feed.next([...eye.asArray(), ...forward.asArray()], now);
    if (!arrays) return;
    const { position, rotation, scale, opacity, color } = arrays,
      bytes = this.#bytes,
      floats = new Float32Array(bytes.buffer);
    for (let i = 0; i < this.frames.capacity; i++) {
      const f = (ROW / 4) * i,
        b = ROW * i;
      for (let k = 0; k < 3; k++) {
        floats[f + k] = position[3 * i + k];
        floats[f + 3 + k] = scale[3 * i + k];
        bytes[b + 24 + k] = Math.min(Math.round(255 * color[3 * i + k]), 255);
      }
      bytes[b + 27] = Math.round(255 * opacity[i]);
      // w x y z around 127.5
      for (let k = 0; k < 4; k++) bytes[b + 28 + k] = Math.round(127.5 + 127.5 * rotation[4 * i + ((k + 3) % 4)]);
    }
    mesh.updateData(bytes.buffer, undefined, { flipY: false });
    this.#given = true;
  }

  /// Sets the clock and resolves when the pages of that time are there; the next frame shows it. Rejects where they
  /// cannot be read.
  async load(time) {
    await this.#feed.load(time);
    await this.ready;
  }

  dispose() {
    this.#gone = true;
    this.frames.dispose();
    if (this.#observer) this.#scene.onBeforeRenderObservable.remove(this.#observer);
    this.mesh?.dispose();
    this.mesh = this.#bytes = null;
    this.node.dispose();
  }
}

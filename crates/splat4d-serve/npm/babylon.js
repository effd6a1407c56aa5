// A dynamic scene of Gaussians in Babylon.js: `const take = new Splat4D('scene.s4d', scene)`; it follows the scene's active camera
// by itself. Babylon.js sorts and renders it; motion and colours are evaluated on the CPU. Its interface takes rotations and colours
// in bytes, so that images differ a little from the player's.

import { GaussianSplattingMesh, Matrix, Quaternion, TransformNode, Vector3 } from '@babylonjs/core';
import { Frames } from './frames.js';

const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };
/// Bytes of a Gaussian in the layout that `updateData` takes: position and scale as f32, colour and opacity, rotation w x y z.
const ROW = 32;

export class Splat4D {
  /// The clock and the file: `frames.time`, `play()`, `pause()`, `loop`, `speed`, `meta`.
  frames;
  /// A promise: the index is read. Rejects where there is no such file, or it is damaged.
  ready;
  /// The node to place in the scene.
  node;
  /// Babylon's mesh with this moment's Gaussians, in the file's axes; null until `ready`.
  mesh = null;
  #scene;
  #observer;
  #changed = true;
  #shown = { time: NaN, eye: null, forward: null };

  /// `source`: an address, File, Blob or ArrayBuffer. `up`: the node's axis ('x', 'y', 'z') that points up as the file's up does;
  /// null keeps the file's axes. In a left-handed scene, the default of Babylon.js, z is mirrored. `budget`: bytes of pages that
  /// stay in memory.
  constructor(source, scene, { up = 'y', budget, onchange = () => {} } = {}) {
    const changed = () => ((this.#changed = true), onchange());
    this.#scene = scene;
    this.node = new TransformNode('splat4d', scene);
    this.frames = new Frames(source, { budget, onchange: changed });
    this.ready = this.frames.ready.then(() => {
      const { meta } = this.frames;
      if (!meta) return;
      const hand = new TransformNode('splat4d handedness', scene);
      hand.parent = this.node;
      if (!scene.useRightHandedSystem) hand.scaling.z = -1;
      this.mesh = new GaussianSplattingMesh('splat4d file axes', null, scene);
      this.mesh.parent = hand;
      if (up) {
        const turn = new Quaternion();
        Quaternion.FromUnitVectorsToRef(Vector3.FromArray(meta.up).normalize(), Vector3.FromArray(AXES[up]), turn);
        this.mesh.rotationQuaternion = turn;
      }
      this.#observer = scene.onBeforeRenderObservable.add(() => this.update());
    });
    this.ready.catch(() => {});
  }

  /// Moves the clock and gives Babylon.js the Gaussians of its time, with the colours that the camera sees. Each frame of the scene
  /// calls it.
  update(camera = this.#scene.activeCamera, now = performance.now()) {
    if (!this.mesh || !camera) return;
    const { frames, mesh } = this;
    frames.tick(now);
    const fileFromWorld = Matrix.Invert(mesh.computeWorldMatrix(true));
    const eye = Vector3.TransformCoordinates(camera.globalPosition, fileFromWorld),
      forward = Vector3.TransformNormal(camera.getForwardRay(1).direction, fileFromWorld).normalize();
    const { time, eye: before, forward: ahead } = this.#shown;
    if (!this.#changed && frames.time === time && eye.equals(before) && forward.equals(ahead)) return;
    this.#changed = false;
    this.#shown = { time: frames.time, eye, forward };
    const { count, position, rotation, scale, opacity, color } = frames.at(frames.time, eye.asArray(), forward.asArray());
    if (!count) return mesh.setEnabled(false);
    const bytes = new Uint8Array(ROW * count),
      floats = new Float32Array(bytes.buffer);
    for (let i = 0; i < count; i++) {
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
  }

  /// Sets the clock and resolves when the pages of that time are there; the next frame shows it.
  async load(time) {
    await this.frames.load(time);
    await this.ready;
    this.#changed = true;
  }

  dispose() {
    this.frames.dispose();
    this.#scene.onBeforeRenderObservable.remove(this.#observer);
    this.mesh?.dispose();
    this.node.dispose();
  }
}

import { Camera, GaussianSplattingMesh, Scene, TransformNode } from '@babylonjs/core';
import { Frames, FramesOptions } from './frames.js';

export interface Splat4DOptions extends FramesOptions {
  /** The object's axis that points up as the file's up does; null keeps the file's axes. 'y' where left out. */
  up?: 'x' | 'y' | 'z' | null;
}

/** A dynamic scene of Gaussians that Babylon.js sorts and renders; it follows the scene's active camera. */
export class Splat4D {
  constructor(source: string | URL | File | Blob | ArrayBuffer, scene: Scene, options?: Splat4DOptions);
  /** The clock and the file. */
  readonly frames: Frames;
  /** The index is read. Rejects where there is no such file, or it is damaged. */
  readonly ready: Promise<void>;
  /** To place in the scene. */
  readonly node: TransformNode;
  /** Null until `ready`. */
  readonly mesh: GaussianSplattingMesh | null;
  /** Moves the clock and evaluates its time. Each frame of the scene calls it. */
  update(camera?: Camera, now?: number): void;
  /** Sets the clock and resolves when the pages of that time are there. Rejects where they cannot be read. */
  load(time: number): Promise<void>;
  dispose(): void;
}

import { Camera, Object3D } from 'three';
import { SplatMesh } from '@sparkjsdev/spark';
import { Frames, FramesOptions } from './frames.js';

export interface Splat4DOptions extends FramesOptions {
  /** The object's axis that points up as the file's up does; null keeps the file's axes. 'y' where left out. */
  up?: 'x' | 'y' | 'z' | null;
}

/** Settings of Spark's renderer with which it renders as the player does: `new SparkRenderer({ renderer, ...SETTINGS })`. */
export const SETTINGS: {
  preBlurAmount: number; blurAmount: number; maxStdDev: number; minAlpha: number; sortRadial: boolean; accumExtSplats: boolean;
};

/** A dynamic scene of Gaussians as an object that Spark sorts and renders. */
export class Splat4D extends Object3D {
  readonly isSplat4D: true;
  constructor(source: string | URL | File | Blob | ArrayBuffer, options?: Splat4DOptions);
  /** The clock and the file. */
  readonly frames: Frames;
  /** The index is read. Rejects where there is no such file, or it is damaged. */
  readonly ready: Promise<void>;
  /** Null until `ready`. */
  readonly mesh: SplatMesh | null;
  /** Moves the clock and evaluates its time, as `camera` sees it. Call it before each frame. */
  update(camera: Camera, now?: number): void;
  /** Sets the clock and resolves when the pages of that time are there. Rejects where they cannot be read. */
  load(time: number): Promise<void>;
  dispose(): void;
}

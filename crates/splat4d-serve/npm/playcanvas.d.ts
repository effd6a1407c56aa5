import { AppBase, Entity } from 'playcanvas';
import { Frames, FramesOptions } from './frames.js';

export interface Splat4DOptions extends FramesOptions {
  /** The object's axis that points up as the file's up does; null keeps the file's axes. 'y' where left out. */
  up?: 'x' | 'y' | 'z' | null;
}

/** A dynamic scene of Gaussians that PlayCanvas' engine sorts and renders. */
export class Splat4D {
  constructor(app: AppBase, source: string | URL | File | Blob | ArrayBuffer, options?: Splat4DOptions);
  /** The clock and the file. */
  readonly frames: Frames;
  /** The index is read. Rejects where there is no such file, or it is damaged. */
  readonly ready: Promise<void>;
  /** To place in the scene. */
  readonly entity: Entity;
  /** Moves the clock and evaluates its time, as the entity `camera` sees it. Call it before each frame. */
  update(camera: Entity, now?: number): void;
  /** Sets the clock and resolves when the pages of that time are there. Rejects where they cannot be read. */
  load(time: number): Promise<void>;
  destroy(): void;
}

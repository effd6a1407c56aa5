import type { LadderState } from './element.js';

export interface FramesOptions {
  /** Pages came: what `at` returns changes. */
  onchange?: () => void;
  /** A page could not be read, for example of a truncated file. */
  onerror?: (error: Error) => void;
  /** Bytes of pages that stay in memory. */
  budget?: number;
  /** The rung of a bitrate ladder that alone is loaded, 1 the coarsest. 'auto' where left out. */
  rung?: 'auto' | number;
}

/** What is visible at a time, in the file's axes. The arrays are those of the next call too. */
export interface FrameArrays {
  count: number;
  /** 3 per Gaussian, scene units. */
  position: Float32Array;
  /** x y z w. */
  rotation: Float32Array;
  /** 3 standard deviations, scene units. */
  scale: Float32Array;
  /** 0 to 1. */
  opacity: Float32Array;
  /** 3 display values, at least 0. */
  color: Float32Array;
}

/** The Gaussians of a playback file at any time as arrays, for engines that render them by themselves. */
export class Frames {
  constructor(source: string | URL | File | Blob | ArrayBuffer, options?: FramesOptions);
  readonly meta: { clip: [number, number]; fps: number; up: [number, number, number]; title?: string } | null;
  readonly ready: Promise<void>;
  /** Most Gaussians at any time. */
  readonly capacity: number;
  /** The clock, s. Set it, or `play()` and call `tick()` each frame. */
  time: number;
  play(): void;
  pause(): void;
  readonly paused: boolean;
  loop: boolean;
  /** 0.1 to 4. */
  speed: number;
  readonly duration: number;
  /** At `time`; null for a file without a ladder. */
  readonly ladder: LadderState | null;
  tick(now?: number): void;
  /** Sets the clock and resolves when the pages of that time are there. Rejects where one of them cannot be read. */
  load(time: number): Promise<void>;
  /** `eye`: colours are those seen from there; `forward`: what is nearer than the capture's cameras could see is left out. */
  at(time: number, eye?: ArrayLike<number> | null, forward?: ArrayLike<number> | null): FrameArrays;
  dispose(): void;
}

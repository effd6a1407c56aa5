import { Matrix4, Mesh } from 'three';
import type { LadderState } from './element.js';

export type { LadderState };

export interface Splat4DOptions {
  /** A better image can be drawn: pages came, or a new order. */
  onchange?: () => void;
  /** Bytes of Gaussians that stay in memory. */
  budget?: number;
  /** The object's axis that points up as the file's up does; null keeps the file's axes. 'y' where left out. */
  up?: 'x' | 'y' | 'z' | null;
  /** Load the file's sound after the first image, and play it with the clock. */
  sound?: boolean;
  /** The rung of the file's bitrate ladder that alone is rendered, 1 the coarsest. 'auto' where left out. */
  rung?: 'auto' | number;
}

/** What is heard; it fires volumechange. */
export interface Sound extends EventTarget {
  muted: boolean;
  /** 0 to 1. */
  volume: number;
  /** The browser refuses to play before a gesture of the page's user: call `touched` in one. */
  readonly blocked: boolean;
  touched(): void;
  /** Whether the file's sound is loaded. */
  readonly there: boolean;
}

/** A moving scene of Gaussians as an object of three.js; works with WebGLRenderer. */
export class Splat4D extends Mesh {
  readonly isSplat4D: true;
  constructor(source: string | URL | File | Blob | ArrayBuffer, options?: Splat4DOptions);
  /** The file's metadata, once `ready` is. */
  readonly meta: { clip: [number, number]; fps: number; up: [number, number, number]; title?: string } | null;
  readonly ready: Promise<void>;
  /** Where the clock is, s. Set it each frame, or play. */
  time: number;
  /** The second that the newest image shows. */
  readonly renderedTime: number;
  play(): void;
  /** Stops at the image that is shown. */
  pause(): void;
  readonly paused: boolean;
  loop: boolean;
  /** 0.1 to 4. */
  speed: number;
  /** Takes positions of the file to the object's. */
  readonly objectFromFile: Matrix4;
  readonly duration: number;
  readonly drawn: number;
  /** The rung of the file's bitrate ladder that alone is rendered, 1 the coarsest. */
  rung: 'auto' | number;
  /** Null for a file without a ladder. */
  readonly ladder: LadderState | null;
  /** Null without the option. */
  readonly sound: Sound | null;
  /** Resolves when `time` is loaded and the next image shows it. */
  settled(): Promise<void>;
  dispose(): void;
}

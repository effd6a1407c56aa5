import { Mesh } from 'three';

export interface Splat4DOptions {
  /** A better picture can be drawn: pages came, or a new order. */
  onchange?: () => void;
  /** Bytes of Gaussians that stay in memory. */
  budget?: number;
}

/** A moving scene of Gaussians as an object of three.js; works with WebGLRenderer. */
export class Splat4D extends Mesh {
  readonly isSplat4D: true;
  constructor(source: string | URL | File | Blob | ArrayBuffer, options?: Splat4DOptions);
  /** The file's metadata, once `ready` is. */
  readonly meta: { clip: [number, number]; fps: number; up: [number, number, number]; title?: string } | null;
  readonly ready: Promise<void>;
  /** Second on the scene's clock. */
  time: number;
  readonly duration: number;
  readonly drawn: number;
  /** Resolves when this moment is loaded and in the order of the last picture. */
  settled(): Promise<void>;
  dispose(): void;
}

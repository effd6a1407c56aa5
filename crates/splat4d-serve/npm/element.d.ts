// <splat-4d>: attributes and events are in docs/player.md of the repository.

export interface CameraState {
  position: [number, number, number];
  /** wxyz: takes the camera's axes (x right, y down, z forward) to the world's. */
  quat: [number, number, number, number];
  target: [number, number, number];
  /** Degrees over the shorter side. */
  fov: number;
}

export type Channel = 'color' | 'depth' | 'alpha' | 'flow';

/** Attributes, as frameworks write them. */
export interface Splat4DAttributes {
  src?: string;
  autoplay?: boolean;
  /** 'false' plays once. */
  loop?: 'true' | 'false';
  time?: number | string;
  speed?: number | string;
  /** 'x,y,z tx,ty,tz fov' */
  camera?: string;
  channel?: Channel;
  /** '#rrggbb'; the scene's own where left out. */
  background?: string;
  backend?: 'auto' | 'webgpu' | 'webgl2';
  resolution?: 'auto' | number;
  controls?: 'none';
  embed?: boolean;
  poster?: string;
  theme?: 'auto' | 'light' | 'dark';
  heading?: string;
  /** Without sound. */
  muted?: boolean;
  /** The rung of the file's bitrate ladder that alone is rendered, 1 the coarsest. */
  rung?: 'auto' | number | string;
  page?: boolean;
}

/** What is rendered of a bitrate ladder; rungs count from 1. */
export interface LadderState {
  /** Rung of what is loaded; 0: none is complete. */
  rung: number;
  /** Rung that is loaded first. */
  chosen: number;
  /** Highest rung that the device renders fast enough. */
  limit: number;
  rungs: number;
  reason: 'start' | 'connection' | 'device' | 'pinned' | 'whole';
  /** Mbit/s of the chosen rung. */
  rate: number;
  /** Gaussians of the time that are not loaded. */
  leftOut: number;
}

export interface Splat4DEventMap extends HTMLElementEventMap {
  load: CustomEvent<{ meta: Record<string, unknown>; milliseconds: number }>;
  timeupdate: CustomEvent<{ time: number }>;
  volumechange: CustomEvent;
  channelchange: CustomEvent<{ channel: Channel }>;
  rungchange: CustomEvent<LadderState>;
  camerachange: CustomEvent<{ camera: CameraState }>;
  error: CustomEvent<{ what: string; where: string; remedy: string }> & ErrorEvent;
}

export class Splat4D extends HTMLElement {
  play(): void;
  pause(): void;
  seek(seconds: number): void;
  step(frames: number): void;
  /** The second that is shown; set it to seek. */
  currentTime: number;
  /** The frame of the last seek is still to come. */
  readonly seeking: boolean;
  readonly duration: number;
  readonly paused: boolean;
  muted: boolean;
  rung: 'auto' | number;
  /** Null for a file without a ladder. */
  readonly ladder: LadderState | null;
  /** 0 to 1. */
  volume: number;
  get camera(): CameraState;
  set camera(camera: Partial<CameraState>);
  set scene(source: File | Blob | ArrayBuffer);
  /** Labels as colours, or the label with this name alone. */
  setLabels(show: { colors?: boolean; only?: string | null }): void;
  screenshot(): Promise<Blob & { time: number }>;
  settled(): Promise<void>;
  readonly link: string;
  readonly statistics: Record<string, unknown>;
  addEventListener<K extends keyof Splat4DEventMap>(
    type: K,
    listener: (this: Splat4D, event: Splat4DEventMap[K]) => unknown,
    options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener(
    type: string,
    listener: EventListenerOrEventListenerObject,
    options?: boolean | AddEventListenerOptions,
  ): void;
}

declare global {
  interface HTMLElementTagNameMap {
    'splat-4d': Splat4D;
  }
}

// What the loaders of Spark, PlayCanvas and Babylon.js share: the Gaussians of a file at its clock's time, for one camera.

import { Frames } from './frames.js';

/// Axes of an engine that can point up.
export const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };

export class Feed {
  /// The clock and the file.
  frames;
  #changed = true;
  /// What the last arrays were computed for: the time, then the numbers of the view.
  #shown = [];

  constructor(source, { budget, onchange = () => {}, onerror } = {}) {
    this.frames = new Frames(source, { budget, onerror, onchange: () => ((this.#changed = true), onchange()) });
  }

  /// Moves the clock to `now`, ms. Returns arrays of `capacity` Gaussians, those without a use with opacity 0: engines reallocate
  /// and reorder when the count changes. Null where nothing changed. `view`: numbers that the arrays depend on, the eye and the
  /// unit direction first, in the file's axes.
  next(view, now) {
    const { frames } = this;
    frames.tick(now);
    const wanted = [frames.time, ...view];
    if (!this.#changed && wanted.every((x, i) => x === this.#shown[i])) return null;
    const arrays = frames.at(frames.time, view.slice(0, 3), view.slice(3, 6));
    arrays.opacity.fill(0, arrays.count);
    this.#changed = false;
    this.#shown = wanted;
    return arrays;
  }

  async load(time) {
    await this.frames.load(time);
    this.#changed = true;
  }
}

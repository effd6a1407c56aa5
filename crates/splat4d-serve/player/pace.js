// How large the image is drawn, so that it keeps pace: lowered where frames come too slowly, raised again where there
// is time to spare, and left alone where fewer pixels do not help.

/** Frames a second that are kept, and above which the image may grow again. */
const KEEP = 30;
const SPARE = 48;
/** Smallest scale: a quarter of the pixels a side is still legible. */
const SCALE_MIN = 0.25;
/** Milliseconds and frames between two changes; with frames of half a second three must do. */
const EVERY = 500;
const FRAMES = 6;
const FEW = 3;
/** A scale that was too slow, or a lowering that was of no use, is not tried again for so long, ms. */
const MEMORY = 8000;
/** A lowering that makes frames faster by less than this was of no use. */
const GAIN = 1.1;
/** Share of the newest frame in the mean. */
const SMOOTH = 0.15;

/** Images that the graphics processor works on, and how long it took for the newest finished one. */
export class Flight {
  count = 0;
  ms = 0;
  #begun = [];
  #ended = 0;

  begin(now) {
    this.#begun.push(now);
    this.count++;
  }

  /** The oldest is finished; the time that it waited behind another does not count. */
  end(now) {
    this.ms = now - Math.max(this.#begun.shift(), this.#ended);
    this.#ended = now;
    this.count--;
  }
}

/** Share of a slower frame in the cost of its scale; a faster one counts at once: what was slow before was something else. */
const SLOWER = 0.2;

/** What a frame costs at a scale: milliseconds that every frame takes, and others that grow with the pixels. */
export class Cost {
  /** scale → ms. */
  #seen = new Map();
  #newest = 0;

  /** A frame at `scale` took `ms`. */
  record(scale, ms) {
    const mean = this.#seen.get(scale);
    this.#seen.set(scale, ms < (mean ?? Infinity) ? ms : mean + SLOWER * (ms - mean));
    this.#newest = scale;
  }

  /** Milliseconds at `scale`; 0 where nothing is known. */
  at(scale) {
    const [here, perPixel] = this.#line();
    return here + perPixel * (scale ** 2 - this.#newest ** 2);
  }

  /** The largest scale, 1 at most and `least` at least, at which a frame takes `ms`. */
  within(ms, least) {
    const [here, perPixel] = this.#line();
    if (!(perPixel > 0)) return 1;
    return Math.min(1, Math.max(least, Math.sqrt(Math.max(0, (ms - here) / perPixel + this.#newest ** 2))));
  }

  /** Milliseconds at the newest scale, and how they grow; of a single scale all of it is taken to be the pixels'. */
  #line() {
    const scale = this.#newest, here = this.#seen.get(scale) ?? 0;
    const far = [...this.#seen.keys()].reduce((a, b) => (Math.abs(b - scale) > Math.abs(a - scale) ? b : a), scale);
    if (far === scale) return [here, scale ? here / scale ** 2 : 0];
    return [here, Math.max(0, (this.#seen.get(far) - here) / (far ** 2 - scale ** 2))];
  }
}

export class Pace {
  scale = 1;
  /** Mean milliseconds of a frame. */
  frameMs = 0;
  #frames = 0;
  #changed = 0;
  #trial = null;
  #tooSlow = { scale: Infinity, at: 0 };
  #rest = -Infinity;

  get fps() { return this.frameMs ? 1000 / this.frameMs : 0; }

  /** Whether fewer pixels cannot, or would not, make frames faster. */
  stuck(now) { return this.scale <= SCALE_MIN || now - this.#rest < MEMORY; }

  /** A frame took `ms`, drawn at the present scale unless `fixed`; `now` in ms. */
  frame(ms, now, fixed = false) {
    // The first frame after a change still has the previous resolution.
    this.frameMs = this.#frames++ > 1 ? this.frameMs + SMOOTH * (ms - this.frameMs) : ms;
    const since = now - this.#changed, enough = since > 4 * EVERY ? FEW : FRAMES;
    if (fixed || this.#frames < enough || since < EVERY) return;
    const { fps, scale } = this, trial = this.#trial;
    this.#trial = null;
    if (trial && fps < trial.fps * GAIN) {
      this.#rest = now;
      this.#change(trial.scale, now);
    } else if (fps < 0.95 * KEEP && scale > SCALE_MIN && now - this.#rest > MEMORY) {
      this.#trial = { scale, fps };
      this.#tooSlow = { scale, at: now };
      this.#change(Math.max(SCALE_MIN, scale * Math.min(0.9, Math.max(0.35, Math.sqrt(fps / KEEP)))), now);
    } else if (fps > SPARE && scale < 1) {
      const up = Math.min(1, scale * 1.15);
      if (up < this.#tooSlow.scale || now - this.#tooSlow.at > MEMORY) this.#change(up, now);
    }
  }

  #change(scale, now) {
    this.scale = scale;
    this.#frames = 0;
    this.#changed = now;
  }
}

/// Whether WebGL states that it is computed on the CPU.
export function software(gl) {
  const asked = gl?.getExtension?.('WEBGL_debug_renderer_info');
  return !!asked && /swiftshader|llvmpipe|software|basic render/i.test(gl.getParameter(asked.UNMASKED_RENDERER_WEBGL));
}

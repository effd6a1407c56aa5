// Which time of the scene is rendered when. An order and its alive set hold for one time only, and a worker computes
// them while the clock runs on. Therefore a frame is rendered at the time of its order, and the next order is requested
// ahead of the clock by the measured latency. Pure logic: nothing here touches a browser.

/// Latency before anything is measured, ms: one frame of a 60 Hz screen.
const FIRST_LATENCY = 1000 / 60;
/// Longest latency that is predicted, ms; a sample this many times the mean is an outlier (a busy or hidden tab).
const LATENCY_MAX = 1000,
  OUTLIER = 3;
/// Share of the newest sample in the mean latency.
const SMOOTH = 0.3;
/// Speed of the requested times while the latency shrinks, as a share of the clock's.
const CATCH_UP = 0.25;
/// Views of one frame (two eyes) are requested within this, ms.
const SAME_FRAME = 2;
/// A camera that turned further than this since its order was requested (cosine) gets no frame of its own: Gaussians
/// behind the earlier camera are missing in that order.
const TURN_MAX = Math.cos(Math.PI / 6);
/// Eyes whose axes are turned apart further than this (cosine) get an order each. A shift changes no order by depth: along
/// an axis it adds the same to all depths, across it nothing.
const CANTED = Math.cos(Math.PI / 180);

/// The views, of the eyes of one frame, that need an order of their own: one, or two.
export function sorted(eyes) {
  const [first] = eyes,
    axis = (view) => view.cameraFromWorld.slice(8, 11),
    along = (view) => axis(first).reduce((sum, x, k) => sum + x * axis(view)[k], 0);
  return eyes.some((view) => along(view) < CANTED) ? eyes.slice(0, 2) : [first];
}

/// Moves a clock by `step` seconds within `clip` {first, last, frameTime, loop}. The last frame is shown as long as the
/// others, so that a loop lasts `last + frameTime - first`. Returns {time, ended}.
export function advance(time, step, { first, last, frameTime, loop }) {
  const end = last + frameTime,
    t = time + step;
  if (loop) return { time: t < end && t >= first ? t : first + modulo(t - first, end - first), ended: false };
  return t < last ? { time: Math.max(t, first), ended: false } : { time: last, ended: true };
}

const modulo = (x, n) => ((x % n) + n) % n;

/// Requests orders from an `Order` and states which of them are rendered.
export class Schedule {
  /// The newest order that is to be rendered: {time, epoch, view}; null before the first one of a scene.
  current = null;
  /// What the newest image shows: {time, epoch}.
  shown = null;
  /// Mean ms from the request of an order to its first frame, while a clock runs.
  latency = FIRST_LATENCY;
  #order;
  #wanted = null;
  #asked = null;
  #skipped = false;
  #least = 0;
  /// When the last order was requested, and the time it was requested for, ms.
  #askedAt = 0;
  #due = -Infinity;
  #rendered = null;
  /// When the last frame began, and ms between two frames.
  #frameAt = NaN;
  #interval = Infinity;

  constructor(order) {
    this.#order = order;
  }

  /// What is to be shown: `time` now; `at(ms)`, where a clock runs, the time at a later `performance.now()`, null where
  /// that cannot be rendered yet; `epoch` counts jumps of the clock; `view` the camera, `cameraFromWorld` its 3x4
  /// matrix; `eyes` all cameras of a headset's frame; `fovea` what their edges leave out (fovea.js).
  want(wanted, now) {
    if (wanted.epoch !== this.#wanted?.epoch) this.#due = -Infinity;
    this.#wanted = wanted;
    if (this.fresh && this.#rendered && this.#skips(this.current)) this.current = this.#rendered;
    if (now - this.#frameAt < SAME_FRAME) return;
    this.#interval = now - this.#frameAt || Infinity;
    this.#frameAt = now;
  }

  /// Requests the order that is missing. Returns whether one is on its way.
  ask(now) {
    if (this.#order.busy) return true;
    const wanted = this.#wanted;
    if (!wanted) return false;
    const { at, epoch, view, eyes = null, fovea = null } = wanted;
    let { time } = wanted;
    if (at) {
      // A finished one is rendered first; where sorting takes longer than a frame, the next is computed meanwhile.
      if (this.fresh && !(this.current.took > this.#interval)) return false;
      // Never back: a latency that shrinks slows the clock down until they agree.
      this.#due = Math.max(this.#due + CATCH_UP * (now - this.#askedAt), now + this.latency);
      this.#askedAt = now;
      time = at(this.#due);
      if (time === null) return false;
    }
    const { generation } = this.#order,
      views = (eyes ? sorted(eyes) : [view]).map((v) => v.cameraFromWorld),
      depths = views.map((m) => [m[8], m[9], m[10], m[11]]),
      have = this.current,
      same = have && Object.is(have.time, time) && have.generation === generation && have.fovea === fovea;
    if (same && have.depths.join() === depths.join()) {
      // A jump to where it is already needs no order.
      have.epoch = epoch;
      if (this.#rendered === have) this.shown = { time, epoch };
      return false;
    }
    this.#asked = { time, epoch, view, generation, depths, fovea, now, ahead: !!at };
    this.#order.ask(time, views, fovea);
    return true;
  }

  /// An order that was requested ahead of a clock which jumped or stopped meanwhile is not rendered; but never two in a
  /// row, so that a clock that keeps jumping is followed.
  #skips({ ahead, epoch }) {
    if (!ahead || epoch === this.#wanted?.epoch || this.#skipped) return false;
    this.#skipped = true;
    return true;
  }

  /// An order arrived. Returns whether it is `current`, and rendered next. What the newest image was rendered from must
  /// be kept until then: `want` may return to it.
  arrived(now) {
    const asked = this.#asked;
    if (asked.generation < this.#least || this.#skips(asked)) return false;
    this.current = { ...asked, took: now - asked.now };
    return true;
  }

  /// Whether an order is there that no image shows.
  get fresh() {
    return this.current !== null && this.current !== this.#rendered;
  }

  /// An image of the current order is being rendered.
  rendered(now) {
    const { current } = this;
    if (this.fresh) {
      const sample = Math.min(now - current.now, OUTLIER * this.latency, LATENCY_MAX);
      if (current.ahead) this.latency += SMOOTH * (sample - this.latency);
      this.#rendered = current;
      this.#skipped = false;
    }
    this.shown = { time: current.time, epoch: current.epoch };
  }

  /// The camera of the next image: the newest one, or after a cut the one that the order was computed for.
  viewOf(newest) {
    const { depths: [depth], view } = this.current,
      m = newest.cameraFromWorld;
    const turned = depth[0] * m[8] + depth[1] * m[9] + depth[2] * m[10] < TURN_MAX;
    return turned && view.width === newest.width && view.height === newest.height ? view : newest;
  }

  /// Another scene begins: no order of the previous one is rendered any more.
  reset() {
    this.current = this.shown = this.#rendered = this.#wanted = null;
    this.#due = -Infinity;
    this.#least = this.#order.generation;
  }
}

/// Follows a clock that a page sets itself, and predicts it: how fast it runs, and that it begins again.
export class Follower {
  /// Counts jumps and stops of the clock.
  epoch = 0;
  #time = NaN;
  #now = NaN;
  #rate = 0;
  #loop = false;

  /// The clock reads `time` for the frame at `now`, ms; `clip` [first, last].
  set(time, now, [first, last]) {
    const step = time - this.#time,
      passed = (now - this.#now) / 1000;
    // Several views of a frame, or a page that sets its clock less often than it renders.
    if (step === 0 && passed < STILL) return;
    const before = this.#rate;
    const begins = before !== 0 && step < 0 === before > 0 && Math.abs(step) > (last - first) / 2;
    // An order for the beginning may be on its way already, where the loop is known.
    const known = begins && this.#loop;
    if (begins) this.#loop = true;
    else {
      const rate = passed > 0 && passed < PAUSE ? step / passed : 0;
      this.#rate = Math.abs(rate) <= RATE_MAX ? rate : 0;
    }
    if (!known && (begins || this.#rate === 0 || before === 0)) this.epoch++;
    this.#time = time;
    this.#now = now;
  }

  /// The function that gives the clock's time at a later `performance.now()`; null where it is stopped.
  at([first, last]) {
    if (!this.#rate) return null;
    return (ms) => {
      const t = this.#time + (this.#rate * (ms - this.#now)) / 1000;
      if (t >= first && t <= last) return t;
      if (this.#loop && last > first) return first + modulo(t - first, last - first);
      return Math.min(Math.max(t, first), last);
    };
  }
}

/// A clock that was not set for this long counts as stopped, s; after a longer gap it has jumped, s; so does a faster
/// one.
const STILL = 0.05,
  PAUSE = 1,
  RATE_MAX = 8;

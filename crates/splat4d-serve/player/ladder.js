// A bitrate ladder (docs/format.md, "Ladder"): which rung of a file is loaded and rendered, by the measured throughput of
// the connection and the measured time of a frame. Pure logic: nothing here touches a browser.

/// Busy time of a connection that makes a sample, ms; fewer bytes than this are latency and no sample of their own. An
/// open request that brings nothing for so long is slow, ms: a page that is busy reads late.
const SAMPLE = 200,
  SMALL = 32 << 10,
  SILENT = 1000;
/// Samples that count, and the newest ones that a drop shows in at once.
const SAMPLES = 8,
  NEWEST = 2;
/// Share of the throughput that a rung may need: to be kept, and to be chosen.
const KEPT = 0.95,
  CHOSEN = 0.8;
/// No higher rung so long after a lower one was chosen, ms; a clock that waits for so long needs the lowest one, ms.
const CALM = 3000,
  STALLED = 400;
/// Frames, and ms, between two changes for the device's sake.
const FRAMES = 8,
  EVERY = 1000;
/// A frame that takes longer, ms (27 per second), is too slow; a higher rung is tried below (48 per second), at first so
/// long after a drop, ms, and twice as long each time that it was too slow again, up to the last.
const SLOW = 37,
  FAST = 21,
  REST = 8000,
  REST_MAX = 120_000;
/// Share of the newest frame in the mean.
const SMOOTH = 0.2;

/// Bits per second of a connection while it is busy: the harmonic mean of the last samples, or less where the newest are
/// slower. Counted by the page, or, where the browser states them, by its own times of requests (`timed`): a page that
/// renders slowly reads late.
export class Throughput {
  #open = 0;
  #since = 0;
  #busy = 0;
  #bytes = 0;
  #samples = [];
  #timed = [];
  #waits = [];
  #upto = 0;
  #sum = { bytes: 0, ms: 0 };

  /// The browser's own times of a finished request: when it began, its first byte came and its last, ms. Times that
  /// overlap count once. The shortest wait for a first byte is the latency: short answers would measure little else.
  timed(bytes, from, first, to) {
    const sum = this.#sum;
    this.#waits.push(first - from);
    if (this.#waits.length > SAMPLES) this.#waits.shift();
    const latency = Math.min(...this.#waits, 0.8 * (to - from));
    sum.ms += Math.max(0, to - Math.max(from + latency, this.#upto));
    sum.bytes += bytes;
    this.#upto = Math.max(this.#upto, to);
    if (sum.bytes < SMALL) return;
    this.#timed.push({ bytes: sum.bytes, ms: Math.max(sum.ms, 1) });
    if (this.#timed.length > SAMPLES) this.#timed.shift();
    sum.bytes = sum.ms = 0;
  }

  /// A request begins.
  begin(now) {
    if (!this.#open++) this.#since = now;
  }

  /// `bytes` arrived.
  add(bytes, now) {
    this.#bytes += bytes;
    if (this.#busy + now - this.#since >= SAMPLE) this.#close(now);
  }

  /// A request ended.
  end(now) {
    this.#open--;
    if (this.#open > 0) return;
    this.#busy += now - this.#since;
    this.#since = now;
    if (this.#bytes >= SMALL) this.#close(now);
  }

  #close(now) {
    const ms = this.#busy + (this.#open ? now - this.#since : 0);
    this.#samples.push({ bytes: this.#bytes, ms: Math.max(ms, 1) });
    if (this.#samples.length > SAMPLES) this.#samples.shift();
    this.#busy = this.#bytes = 0;
    this.#since = now;
  }

  /// Bits per second; 0 before anything was measured. A connection that is silent counts as slow.
  rate(now) {
    const silent = this.#open ? this.#busy + now - this.#since : 0,
      samples = this.#timed.length ? this.#timed : this.#samples,
      all = silent > SILENT ? [...samples, { bytes: this.#bytes, ms: silent }] : samples;
    const mean = (list) => (8000 * list.reduce((n, s) => n + s.bytes, 0)) / list.reduce((n, s) => n + s.ms, 0);
    return all.length ? Math.min(mean(all), mean(all.slice(-NEWEST))) : 0;
  }
}

/// Which rung is loaded, and above which none is rendered. Rungs count from 0 here, and from 1 for users.
export class Ladder {
  /// [{rate: bits per second, tiers}], the coarsest first; a file without a ladder has one rung.
  rungs;
  /// Why the rung is the one that it is: 'start', 'connection', 'device', 'pinned', or 'whole' for the highest.
  reason = 'start';
  #chosen = 0;
  #cap;
  #pinned = null;
  #lowered = -Infinity;
  #stalled = NaN;
  #measured = false;
  /// Of the device: mean ms of a frame, frames and ms since the last change, ms until a higher rung is tried.
  #ms = 0;
  #frames = 0;
  #changed = -Infinity;
  #rest = REST;
  #raised = -Infinity;

  constructor(rungs = []) {
    this.rungs = rungs?.length ? rungs : [{ rate: 0, tiers: Infinity }];
    this.#cap = this.rungs.length - 1;
  }

  get length() {
    return this.rungs.length;
  }

  /// The rung whose pages are loaded first.
  get wanted() {
    return this.#pinned ?? Math.min(this.#chosen, this.#cap);
  }

  /// The highest rung that may be rendered; higher ones are loaded only while the connection is idle.
  get cap() {
    return this.#pinned ?? this.#cap;
  }

  /// Pages with a lower tier belong to rung `k`.
  tiers(k) {
    return this.rungs[Math.min(Math.max(k, 0), this.rungs.length - 1)].tiers;
  }

  /// One rung, whatever is measured; null: as measured.
  get pinned() {
    return this.#pinned;
  }
  set pinned(k) {
    this.#pinned = k === null || !Number.isFinite(k) ? null : Math.min(Math.max(Math.round(k), 0), this.rungs.length - 1);
    this.#say(this.#pinned === null ? 'connection' : 'pinned');
  }

  /// The connection gives `rate` bits per second (0: not measured, Infinity: what is in memory); the clock runs at
  /// `speed` and is `waiting` for pages or not.
  steer(now, { rate, speed = 1, waiting = false }) {
    const top = this.rungs.length - 1;
    const within = (share) => Math.max(0, this.rungs.findLastIndex((r) => r.rate * Math.max(Math.abs(speed), 0.1) <= share * rate));
    const before = this.#chosen;
    if (!waiting) this.#stalled = NaN;
    else if (!(now - this.#stalled < Infinity)) this.#stalled = now;
    if (rate === Infinity) this.#chosen = top;
    else if (rate > 0) {
      const kept = within(KEPT),
        up = within(CHOSEN);
      if (this.#chosen > kept) this.#chosen = kept;
      else if (up > this.#chosen && (!this.#measured || now - this.#lowered > CALM)) this.#chosen = up;
      this.#measured = true;
      if (now - this.#stalled > STALLED) this.#chosen = 0;
    }
    if (this.#chosen < before) this.#lowered = now;
    if (this.#chosen !== before && this.#pinned === null) this.#say('connection');
  }

  /// A frame of rung `shown` took `ms`. `stuck`: fewer pixels do not help; `slow` and `fast`: ms beyond which a frame is
  /// too slow, and below which there is time to spare.
  frame(ms, now, shown, { stuck = true, slow = SLOW, fast = FAST } = {}) {
    if (this.rungs.length < 2 || this.#pinned !== null) return;
    // The first frame after a change still has the previous Gaussians.
    this.#ms = this.#frames++ > 1 ? this.#ms + SMOOTH * (ms - this.#ms) : ms;
    if (this.#frames === 1) this.#changed = Math.max(this.#changed, now - ms);
    const since = now - this.#changed;
    if (this.#frames < FRAMES || since < EVERY) return;
    if (this.#ms > slow && stuck && shown > 0) {
      // A rung that was tried and is too slow again is left for longer.
      if (now - this.#raised < 2 * this.#rest) this.#rest = Math.min(2 * this.#rest, REST_MAX);
      this.#set(Math.min(shown, this.#cap) - 1, now);
    } else if (this.#ms < fast && this.#cap < this.rungs.length - 1 && since > this.#rest) {
      this.#raised = now;
      this.#set(this.#cap + 1, now);
    }
  }

  #set(cap, now) {
    this.#cap = cap;
    this.#changed = now;
    this.#frames = 0;
    this.#say('device');
  }

  #say(reason) {
    const limited = this.#cap < this.rungs.length - 1 && this.#cap <= this.#chosen;
    if (this.#pinned !== null) this.reason = 'pinned';
    else if (limited) this.reason = 'device';
    else if (this.wanted === this.rungs.length - 1) this.reason = 'whole';
    else this.reason = reason === 'device' ? 'connection' : reason;
  }
}

/// The rung that an attribute or option names, from 1 on; null for 'auto' and what is none.
export function rungOf(text) {
  const k = Number(text);
  return text !== null && text !== '' && Number.isInteger(k) && k >= 1 ? k - 1 : null;
}

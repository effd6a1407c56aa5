// Keeps the right pages in a backend: first those of this time (most important tier first), then those just ahead;
// above its budget it drops the pages farthest in time, never of what this time needs. Of a file with a bitrate ladder,
// pages of the rung that `ladder.js` chooses: the coarsest rung first, those of higher rungs while the connection is idle.

import { isAbort } from './errors.js';
import { painted } from './labels.js';
import { Ladder } from './ladder.js';

/// Bytes of 32-bit words that stay resident, by default, and on small machines (navigator.deviceMemory, GiB).
const BUDGET = 512 << 20,
  SMALL_BUDGET = 128 << 20,
  SMALL_MEMORY = 4;
/// Bytes per Gaussian (docs/format.md: 8 words).
const GAUSSIAN = 32;
/// Bytes that a page and its key masks take.
const cost = (page) => page.count * GAUSSIAN + (page.maskBytes ?? 0);
/// Looked ahead while playing, s of the viewer's time; to both sides while not, s of the scene's.
const AHEAD = 2,
  BESIDE = 0.5;
/// Times on the scene clock change each frame; a plan is made again when one moved by this part of what is looked
/// ahead.
const STEP = 8;
/// Pages in flight for later: few, so that a seek is not behind many.
const LATER = 4;
/// While coarse pages with more bytes than this are on their way, no finer ones of their time are: they would share the line.
const HEAVY = 256 << 10;
/// The throughput of the connection is examined at this interval, ms.
const STEER = 200;
/// Pages of higher rungs in flight while the connection is idle.
const IDLE = 2;
/// A page is tried this often; after the last failure it rests, ms.
const TRIES = 2,
  REST = 10_000;

/// The budget for this machine, bytes.
export function defaultBudget() {
  const memory = globalThis.navigator?.deviceMemory ?? 8;
  return memory <= SMALL_MEMORY ? SMALL_BUDGET : BUDGET;
}

export class Stream {
  #file;
  #backend;
  #budget;
  #onchange;
  #onerror;
  #onleft;
  #show;
  #resident = new Set();
  /// Those of them whose key masks are in the backend.
  #masked = new Set();
  /// id → AbortController of what is on its way.
  #flight = new Map();
  #bytes = 0;
  /// id → {tries, at}: pages that failed.
  #failed = new Map();
  /// palette id → promise of its being in the backend.
  #palettes = new Map();
  #now = [];
  #later = [];
  /// The pages of the last update's time: the same list as long as no span begins or ends.
  #active = [];
  #begun = -1;
  #ended = -1;
  /// When a page that was given up may be tried again.
  #again = Infinity;
  #last = { time: NaN, active: null, step: NaN, playing: false, speed: 1, loop: true, tiers: 0, cap: 0 };
  /// Pages of this time and of later ones beyond the chosen rung: loaded while the connection is idle.
  #more = [];
  #steered = -Infinity;
  #waiting = [];
  #over = false;
  #starts;
  #ends;
  /// Pages of the coarsest tier of their span, and those of now that exceed the budget.
  #coarse;
  #leftOut = new Set();

  /// `file`: SceneFile. `backend`: of PLAYER's interface; it owns the arrays it is given. `budget`: bytes of words.
  /// `onchange()` after each page that was added or dropped, `onerror(SceneError)` for a page that is given up for now,
  /// `onleft(Gaussians)` when a time first does not fit into the budget. `show`: labels as `painted` needs it, null:
  /// pages are shown unchanged. `ladder`: the choice of the rung, which outlives a stream.
  constructor(file, backend, { budget = defaultBudget(), onchange, onerror, onleft, show = null, ladder } = {}) {
    this.#show = show;
    this.ladder = ladder ?? new Ladder(file.meta.ladder);
    this.#file = file;
    this.#backend = backend;
    this.#budget = Math.min(budget, backend.capacity ?? Infinity);
    this.#onchange = onchange ?? (() => {});
    this.#onerror = onerror ?? (() => {});
    this.#onleft = onleft ?? (() => {});
    const coarsest = new Map(),
      first = this.ladder.tiers(0);
    for (const { from, to, tier } of file.pages) {
      // A span that has nothing in the lowest rung is not waited for.
      if (tier >= first) continue;
      const span = `${from} ${to}`;
      coarsest.set(span, Math.min(tier, coarsest.get(span) ?? tier));
    }
    this.#coarse = new Set(file.pages.filter((p) => p.tier === coarsest.get(`${p.from} ${p.to}`)).map((p) => p.id));
    this.#starts = Float64Array.from(file.pages, (p) => p.from).sort();
    this.#ends = Float64Array.from(file.pages, (p) => p.to).sort();
  }

  /// Bytes of words and masks that are resident.
  get bytes() {
    return this.#bytes;
  }

  /// Gaussians of this time that exceed the budget: those of the last tiers.
  left = 0;

  /// Pages on their way.
  get loading() {
    return this.#flight.size;
  }

  /// Reports what is shown. Cheap where nothing changed: call it every frame.
  update(time, { playing = false, speed = 1, loop = true } = {}) {
    if (this.#over) return;
    const t = this.#file.clamp(time);
    const begun = before(this.#starts, t);
    const ended = before(this.#ends, t);
    if (begun !== this.#begun || ended !== this.#ended) {
      [this.#begun, this.#ended, this.#active] = [begun, ended, this.#file.activePages(t)];
    }
    const active = this.#active;
    // Later times are examined again in coarse steps only.
    const reach = playing ? Math.max(Math.abs(speed), 0.1) * AHEAD : BESIDE;
    const step = Math.floor((t / reach) * STEP);
    const last = this.#last,
      now = performance.now();
    last.time = t;
    if (now - this.#steered >= STEER) {
      this.#steered = now;
      // The time before the first image is no waiting: nothing is late yet.
      const waiting = playing && this.#resident.size > 0 && !this.playable(t);
      this.ladder.steer(now, { rate: this.#file.rate?.(now) ?? Infinity, speed: playing ? speed : 1, waiting });
    }
    const tiers = this.ladder.tiers(this.ladder.wanted),
      cap = this.ladder.tiers(this.ladder.cap);
    const rung = last.tiers === tiers && last.cap === cap;
    const same = rung && last.active === active && last.step === step && last.playing === playing;
    if (same && last.speed === speed && last.loop === loop && now < this.#again) return;
    Object.assign(last, { active, step, playing, speed, loop, tiers, cap });
    this.#again = Infinity;
    this.#plan(t, playing, speed, loop, reach);
    this.#pump();
  }

  /// Share of the Gaussians of `time` that are resident, 0 to 1; of the rung that is loaded, or of rung `k`.
  ready(time, k = this.ladder.wanted) {
    const tiers = this.ladder.tiers(this.ladder.pinned ?? k);
    let all = 0,
      there = 0;
    for (const page of this.#pagesOf(time)) {
      if (page.tier >= tiers) continue;
      all += page.count;
      if (this.#resident.has(page.id)) there += page.count;
    }
    return all ? there / all : 1;
  }

  /// The highest rung of which all pages of `time` are resident, -1: none; and the Gaussians of `time` that are not.
  shown(time) {
    let [left, first] = [0, Infinity];
    for (const page of this.#pagesOf(time)) {
      if (this.#resident.has(page.id)) continue;
      left += page.count;
      first = Math.min(first, page.tier);
    }
    return { rung: this.ladder.rungs.findLastIndex((r) => r.tiers <= first), left };
  }

  /// The ladder at `time`, rungs counted from 1: {rung: of what is resident, 0: none is complete; chosen: loaded first;
  /// limit: by the device; rungs; reason; rate: of the chosen one, Mbit/s; leftOut: Gaussians that are not resident}; null
  /// for a file without a ladder.
  rungs(time) {
    const { ladder } = this;
    if (!this.#file.meta.ladder?.length) return null;
    const { rung, left } = this.shown(time),
      rate = ladder.rungs[ladder.wanted].rate / 1e6;
    const [chosen, limit] = [ladder.wanted + 1, ladder.cap + 1];
    return { rung: rung + 1, chosen, limit, rungs: ladder.length, reason: ladder.reason, rate, leftOut: left };
  }

  /// The spans of the clip that could be played now without waiting, as shares of it, from `points` samples.
  buffered(points) {
    const [first, last] = this.#file.meta.clip,
      out = [];
    for (let i = 0; i < points; i++) {
      const [a, b] = [i / points, (i + 1) / points];
      if (!this.playable(first + ((a + b) / 2) * (last - first))) continue;
      if (out.at(-1)?.[1] === a) out.at(-1)[1] = b;
      else out.push([a, b]);
    }
    return out;
  }

  /// Whether an image of `time` would be whole: of every span the coarsest tier is resident, or it was given up, or the
  /// budget does not allow it.
  playable(time) {
    return this.#pagesOf(time).every(({ id }) => {
      if (!this.#coarse.has(id) || this.#resident.has(id) || this.#leftOut.has(id)) return true;
      return this.#failed.get(id)?.tries >= TRIES;
    });
  }

  #pagesOf(time) {
    const t = this.#file.clamp(time);
    const now = before(this.#starts, t) === this.#begun && before(this.#ends, t) === this.#ended;
    return now ? this.#active : this.#file.activePages(t);
  }

  /// Resolves when all pages of `time` are resident, or given up, or more than the budget holds.
  settled(time) {
    const { playing, speed, loop } = this.#last;
    this.update(time, { playing, speed, loop });
    return new Promise((done) => {
      this.#waiting.push(done);
      this.#wake();
    });
  }

  destroy() {
    this.#over = true;
    for (const stop of this.#flight.values()) stop.abort();
    this.#flight.clear();
    for (const done of this.#waiting.splice(0)) done();
  }

  /// Decides what should be resident: `#now` and `#later`, both in the order in which they are needed, within budget.
  #plan(t, playing, speed, loop, reach) {
    const [first, last] = this.#file.meta.clip;
    const { tiers, cap } = this.#last,
      base = this.ladder.length > 1 ? this.ladder.tiers(this.ladder.pinned ?? 0) : Infinity;
    const now = [],
      later = [],
      more = [];
    const forward = speed >= 0;
    for (const page of this.#file.pages) {
      if (page.tier >= cap) {
        // Above the rung that the device can render, or that is pinned.
        if (this.#resident.has(page.id)) this.#drop(page);
        continue;
      }
      if (page.from <= t && t < page.to) {
        page.wait = 0;
        // While it plays, the lowest rung of what is next goes before more of what is rendered already.
        if (page.tier < tiers && (page.tier < base || !playing)) now.push(page);
        else (page.tier < tiers ? later : more).push(page);
        continue;
      }
      // How long until it is needed, on the scene clock; while nothing plays, either way.
      let wait = page.from > t ? page.from - t : Math.max(t - page.to, 0);
      if (playing) {
        wait = forward ? page.from - t : t - page.to;
        const round = forward ? last - t + page.from - first : t - first + last - page.to;
        if (wait < 0) wait = loop ? Math.max(round, 0) : Infinity;
      }
      page.wait = wait;
      if (wait <= reach) (page.tier < tiers ? later : more).push(page);
    }
    const coarse = (page) => (page.tier < base ? 0 : 1);
    now.sort((a, b) => a.tier - b.tier || a.id - b.id);
    later.sort((a, b) => coarse(a) - coarse(b) || a.wait - b.wait || a.tier - b.tier || a.id - b.id);
    more.sort((a, b) => a.wait - b.wait || a.tier - b.tier || a.id - b.id);
    let room = this.#budget;
    const fits = (page) => (cost(page) <= room ? ((room -= cost(page)), true) : false);
    this.#now = now.filter(fits);
    this.#leftOut = new Set(now.filter((page) => !this.#now.includes(page)).map((page) => page.id));
    const sum = (pages) => pages.reduce((n, page) => n + page.count, 0),
      left = sum(now) - sum(this.#now);
    if (left && !this.left) this.#onleft(left);
    this.left = left;
    // What is later may not push out more of itself than the budget has left.
    this.#later = later.filter(fits);
    this.#more = more.filter(fits);
    const needed = [...this.#now, ...this.#later],
      wanted = new Set([...needed, ...this.#more].map((p) => p.id));
    // What is not needed yet gives way to what is missing.
    const busy = needed.some((page) => !this.#resident.has(page.id)),
      kept = busy ? new Set(needed.map((p) => p.id)) : wanted;
    for (const [id, stop] of this.#flight) if (!kept.has(id)) stop.abort();
    this.#shrink(wanted);
  }

  #drop(page) {
    this.#resident.delete(page.id);
    this.#masked.delete(page.id);
    this.#bytes -= cost(page);
    this.#backend.dropPage(page.id);
    this.#onchange();
  }

  /// Drops pages until what is needed fits: the farthest in time first.
  #shrink(wanted) {
    let missing = 0;
    for (const page of [...this.#now, ...this.#later, ...this.#more]) {
      if (!this.#resident.has(page.id)) missing += cost(page);
    }
    if (this.#bytes + missing <= this.#budget) return;
    const { time, playing, speed } = this.#last;
    const far = (page) => {
      const gap = page.from > time ? page.from - time : Math.max(time - page.to, 0);
      // While it plays, past pages are needed later than coming ones.
      const passed = playing && (speed >= 0 ? page.to <= time : page.from > time);
      return passed ? gap + AHEAD : gap;
    };
    const spare = [...this.#resident].filter((id) => !wanted.has(id)).map((id) => this.#file.sections[id]);
    spare.sort((a, b) => far(b) - far(a) || b.tier - a.tier || b.id - a.id);
    for (const page of spare) {
      if (this.#bytes + missing <= this.#budget) break;
      this.#drop(page);
    }
  }

  #wants(page) {
    if (this.#flight.has(page.id)) return false;
    if (this.#resident.has(page.id) && (!(page.mask >= 0) || this.#masked.has(page.id))) return false;
    const failed = this.#failed.get(page.id);
    return !failed || failed.tries < TRIES || performance.now() - failed.at >= REST;
  }

  /// Starts what is to be fetched now: this time's pages all at once, and only when those are there, later ones.
  #pump() {
    if (this.#over) return;
    let open = false;
    const missing = this.#now.filter((page) => this.#coarse.has(page.id) && (this.#flight.has(page.id) || this.#wants(page)));
    const heavy = missing.reduce((n, page) => n + (page.stored ?? 0), 0) > HEAVY;
    for (const page of this.#now) {
      if (heavy && !this.#coarse.has(page.id)) continue;
      if (this.#wants(page)) this.#load(page);
      open ||= this.#flight.has(page.id);
    }
    if (!open) {
      for (const page of this.#later) {
        if (this.#flight.size >= LATER) break;
        if (this.#wants(page)) this.#load(page);
      }
    }
    if (!this.#flight.size || this.#more.some((page) => this.#flight.has(page.id))) {
      for (const page of this.#more) {
        if (this.#flight.size >= IDLE) break;
        if (this.#wants(page)) this.#load(page);
      }
    }
    this.#wake();
  }

  /// The page, unless it is there, and its mask, which is requested at the same time: both lie together in the file.
  /// Until the mask is there, the page is drawn without it.
  async #load(entry) {
    const stop = new AbortController(),
      { signal } = stop;
    this.#flight.set(entry.id, stop);
    try {
      const parts = this.#resident.has(entry.id)
        ? null
        : [
            this.#file.page(entry.id, { signal }),
            entry.palette < 0 ? null : this.#palette(entry.palette),
            this.#show && entry.labels >= 0 ? this.#file.labels(entry.labels, { signal }) : null,
          ];
      const coming = entry.mask >= 0 ? this.#file.mask(entry.mask, { signal }) : null;
      // Waited for below; a page that fails first must not leave it unheard.
      coming?.catch(() => {});
      if (parts) {
        const [page, , labels] = await Promise.all(parts);
        if (signal.aborted) return;
        this.#backend.addPage(...(this.#show ? painted(page, entry, labels, this.#show) : [page, entry]));
        this.#resident.add(entry.id);
        this.#bytes += cost(entry);
        if (coming) this.#onchange();
      }
      if (coming) {
        const mask = await coming;
        if (signal.aborted) return;
        this.#backend.addMask(entry.id, mask);
        this.#masked.add(entry.id);
      }
      this.#failed.delete(entry.id);
      this.#onchange();
    } catch (error) {
      if (signal.aborted || this.#over || isAbort(error)) return;
      const failed = this.#failed.get(entry.id);
      const tries = (failed && performance.now() - failed.at < REST ? failed.tries : 0) + 1;
      this.#failed.set(entry.id, { tries, at: performance.now() });
      if (tries >= TRIES) {
        this.#again = performance.now() + REST;
        this.#onerror(error);
      }
    } finally {
      // An aborted page may be on its way again already, under another controller.
      if (this.#flight.get(entry.id) === stop) this.#flight.delete(entry.id);
      this.#pump();
    }
  }

  /// Fetched once and kept: palettes are small, and most pages share one.
  #palette(id) {
    let there = this.#palettes.get(id);
    if (!there) {
      there = this.#file.palette(id).then((palette) => this.#over || this.#backend.addPalette(palette));
      this.#palettes.set(id, there);
      there.catch(() => this.#palettes.delete(id));
    }
    return there;
  }

  /// Resolves `settled` when nothing of this time is being loaded, of any rung that may be rendered.
  #wake() {
    if (!this.#waiting.length) return;
    const active = [...this.#now, ...[...this.#later, ...this.#more].filter((page) => page.wait === 0 && this.#active.includes(page))];
    if (active.some((page) => this.#flight.has(page.id) || this.#wants(page))) return;
    for (const done of this.#waiting.splice(0)) done();
  }
}

/// How many of the sorted `numbers` are ≤ x.
function before(numbers, x) {
  let low = 0,
    high = numbers.length;
  while (low < high) {
    const mid = (low + high) >> 1;
    if (numbers[mid] <= x) low = mid + 1;
    else high = mid;
  }
  return low;
}

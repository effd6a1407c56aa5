// Sound of a scene: an audio element that follows the player's clock. The clock of the images leads; the sound is
// started where it is, ahead by what starts were late before, and started again where that was not enough. Its speed is
// never bent: browsers step by some 15 ms when that begins and ends.

import { clamp } from './camera.js';
import { SceneError } from './errors.js';

/** Speeds at which sound is stretched with its pitch kept; at others it is silent. */
const STRETCH = [0.5, 2];
/** A difference that is corrected by another start, s: right after a start, later, and at most where nothing helps. */
const EARLY = 0.015, FAR = 0.03, HOPELESS = 0.24;
/** A difference is judged when it has lasted, or the sound was heard, for so long, ms; and most starts in a row. */
const JUDGED = 200, TRIES = 3;
/** Most that a start is ahead of its clock, s. */
const LEAD = 0.3;
/** A clock that was not heard of for longer has stopped: its page is hidden, or renders no more, ms. */
const STALE = 1500;

/** Fires volumechange. Silent until `load` brought the sound of a file. */
export class Sound extends EventTarget {
  /** Whether the browser refuses to play before the page is touched. */
  blocked = false;
  #audio = null;
  /** Whether the browser has read it, and can play it. */
  #there = false;
  #span;
  #muted = false;
  #volume = 1;
  /** How much later than asked it is heard, s: measured at each start. */
  #lead = 0.05;
  /** Since when the last start is heard, and it is off, ms, 0: not; starts in a row, 0: the last one was judged. */
  #since = 0;
  #late = 0;
  #tries = 0;
  /** Starts again above this difference. */
  #far = FAR;
  #wanted = false;
  /** Counts files: a later one, or none, takes the place of one on its way. */
  #turn = 0;
  /** The clock when it was last heard of: {epoch, clock, now}. */
  #before = { now: 0 };

  /** Loads what a SceneFile has, in place of the last; call it after the first image, which it must not delay. */
  async load(file) {
    const turn = ++this.#turn, found = await file.sound();
    if (turn !== this.#turn) return;
    this.drop();
    if (!found) return;
    const audio = this.#audio = new Audio();
    this.#span = found.span;
    Object.assign(audio, { preservesPitch: true, preload: 'auto', muted: this.#muted, volume: this.#volume });
    const decoded = new Promise((done, fail) => {
      audio.addEventListener('loadedmetadata', done);
      audio.addEventListener('error', fail);
    });
    audio.addEventListener('timeupdate', () => { if (performance.now() - this.#before.now > STALE) this.#stop(); });
    document.addEventListener('visibilitychange', this.#hidden);
    audio.src = URL.createObjectURL(found.blob);
    try { await decoded; } catch {
      if (audio !== this.#audio) return;
      this.drop();
      throw new SceneError('This browser cannot play the sound', 'sound', 'The scene plays without it.');
    }
    if (audio !== this.#audio) return;
    this.#there = true;
    this.#changed();
  }

  /** Whether there is sound that this browser plays. */
  get there() { return this.#there; }
  get muted() { return this.#muted; }
  set muted(on) {
    this.#muted = !!on;
    if (this.#audio) this.#audio.muted = this.#muted;
    this.#changed();
  }
  get volume() { return this.#volume; }
  set volume(x) {
    this.#volume = clamp(+x || 0, 0, 1);
    if (this.#audio) this.#audio.volume = this.#volume;
    this.#changed();
  }
  /** Whether something can be heard. */
  get audible() { return this.there && !this.#muted && !this.blocked && this.#volume > 0; }
  /** The second of the scene's clock that is heard; null: none is. */
  get time() {
    const audio = this.#audio;
    return this.#wanted && audio && !audio.paused && !audio.seeking ? this.#span[0] + audio.currentTime : null;
  }

  /** The clock of this moment, once a frame; `epoch` changes with its jumps. */
  follow(clock, { running, speed = 1, epoch = 0 }) {
    const audio = this.#audio, before = this.#before, now = performance.now();
    this.#before = { epoch, clock, now };
    if (!audio) return;
    const at = clock - this.#span[0];
    if (!running || speed < STRETCH[0] || speed > STRETCH[1] || at < 0 || clock >= this.#span[1]) return this.#stop();
    if (!this.#wanted || epoch !== before.epoch || clock < before.clock) return this.#start(at, speed);
    if (this.blocked || audio.paused || audio.seeking || audio.readyState < 2) return;
    this.#since ||= now;
    if (now - this.#since < JUDGED) return;
    const off = (audio.currentTime - at) / speed;
    if (this.#tries) {
      this.#lead = clamp(this.#lead - off, 0, LEAD);
      if (Math.abs(off) > EARLY && this.#tries < TRIES) return this.#jump(at, speed);
      this.#tries = 0;
    }
    if (Math.abs(off) < this.#far) this.#late = 0;
    else if (!this.#late) this.#late = now;
    else if (now - this.#late > JUDGED) {
      this.#far = Math.min(2 * this.#far, HOPELESS);
      this.#lead = clamp(this.#lead - off, 0, LEAD);
      this.#jump(at, speed);
    }
  }

  /** To be called in a gesture of the page's user, which allows sound. */
  touched() {
    if (!this.blocked) return;
    this.blocked = false;
    // In the gesture itself, as some browsers want it; the next frame stops it where nothing plays, or aligns it.
    this.#wanted = true;
    this.#since = 0;
    this.#tries = 1;
    this.#play();
    this.#changed();
  }

  /** Ends the sound of a file. */
  drop() {
    this.#turn++;
    const audio = this.#audio;
    if (!audio) return;
    this.#stop();
    document.removeEventListener('visibilitychange', this.#hidden);
    URL.revokeObjectURL(audio.src);
    this.#audio = null;
    this.#there = false;
    this.blocked = false;
    audio.removeAttribute('src');
    audio.load();
    this.#changed();
  }

  #hidden = () => { if (document.hidden) this.#stop(); };

  #start(at, speed) {
    this.#wanted = true;
    this.#tries = 0;
    this.#far = FAR;
    this.#jump(at, speed);
    if (!this.blocked && this.#audio.paused) this.#play();
  }

  #play() {
    const audio = this.#audio;
    audio.play().catch(error => {
      if (error.name !== 'NotAllowedError' || audio !== this.#audio) return;
      this.blocked = true;
      this.#changed();
    });
  }

  #jump(at, speed) {
    this.#since = this.#late = 0;
    this.#tries++;
    this.#audio.playbackRate = speed;
    this.#audio.currentTime = at + this.#lead * speed;
  }

  #stop() {
    if (!this.#wanted) return;
    this.#wanted = false;
    this.#audio.pause();
  }

  #changed() { this.dispatchEvent(new Event('volumechange')); }
}

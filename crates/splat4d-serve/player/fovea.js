// Foveated culling: where a headset is too slow, the edges of each eye's view get the coarser tiers only. Tiers are ranked
// by renders, so that they lose less than small or faint Gaussians would (studies/records/2026-11-29-headset.md). Pure
// logic: nothing here touches a browser.

import { Ladder } from './ladder.js';

/// Tangent of the angle about an eye's axis within which nothing is left out: the corners of the middle third of a field of
/// 90°.
const INNER = Math.SQRT2 / 3;
/// The ladder waits so long for what thinner edges gain, ms.
const EFFECT = 2000;

export class Fovea {
  /// The file whose tiers these are.
  file;
  /// What Order.ask takes: {inner, tier}, from `tier` on Gaussians are left out at the edges; null: none.
  edge = null;
  #tiers;
  /// When the device is too slow or fast enough is the rule of rungs; here a step has the tiers that the edges keep.
  #steps;
  #kept;
  #lowered = -Infinity;

  /// Of a player's ladder, or of the tiers of its file where that has no ladder.
  constructor({ file, ladder }) {
    this.file = file;
    this.#tiers = ladder.length > 1 ? ladder.rungs.map((rung) => rung.tiers) : [...new Set(file.pages.map((page) => page.tier + 1))].sort((a, b) => a - b);
    this.#steps = new Ladder(this.#tiers.map((tiers) => ({ rate: 0, tiers })));
    this.#kept = this.#steps.cap;
  }

  /// 0: nothing is left out; 1: the edges have the coarsest tiers only.
  get strength() {
    const last = this.#steps.length - 1;
    return last ? 1 - this.#kept / last : 0;
  }

  /// A frame took `ms`. The edges are thinned before the rungs of `ladder` fall, and get everything again after these have
  /// risen; a pinned rung is rendered whole. Returns the limits that remain for the ladder.
  frame(ms, now, ladder, limits) {
    const steps = this.#steps,
      before = steps.cap,
      last = steps.length - 1,
      lower = ladder.cap < ladder.length - 1,
      pinned = ladder.pinned !== null;
    if (!pinned) steps.frame(ms, now, before, { ...limits, fast: lower ? 0 : limits.fast });
    if (steps.cap < before) this.#lowered = now;
    const kept = pinned ? last : steps.cap;
    if (kept !== this.#kept) this.edge = kept < last ? { inner: INNER, tier: this.#tiers[kept] } : null;
    this.#kept = kept;
    return { ...limits, stuck: steps.cap === 0 && now - this.#lowered > EFFECT };
  }
}

// Foveated culling: when the edges of a headset's views are thinned, and which Gaussians an order then leaves out.

import assert from 'node:assert/strict';
import test from 'node:test';
import { Fovea } from '../../player/fovea.js';
import { Ladder } from '../../player/ladder.js';
import '../../player/sort.worker.js';
import { page, view } from './toy.mjs';

const { Sorter, path } = globalThis.splat4dSort;
const RUNGS = [1, 2, 3].map((k) => ({ rate: k * 1e6, tiers: 2 * k }));
const LIMITS = { slow: 20, fast: 15 };

/// A headset whose frames take what `run` states, ms.
class Headset {
  now = 0;
  constructor(ladder, pages = []) {
    this.ladder = ladder;
    this.fovea = new Fovea({ ladder, file: { pages } });
  }
  run(ms, seconds) {
    const states = [];
    for (const end = this.now + 1000 * seconds; this.now < end; this.now += ms) {
      const { ladder, fovea } = this;
      ladder.frame(ms, this.now, ladder.cap, fovea.frame(ms, this.now, ladder, LIMITS));
      const state = `${ladder.cap} ${fovea.edge?.tier ?? 'all'}`;
      if (state !== states.at(-1)) states.push(state);
    }
    return states;
  }
}

test('the edges are thinned before rungs fall, and whole again after they have risen', () => {
  const headset = new Headset(new Ladder(RUNGS));
  assert.deepEqual(headset.run(14, 5), ['2 all'], 'a fast device leaves nothing out');
  assert.equal(headset.fovea.strength, 0);
  assert.deepEqual(headset.run(40, 15), ['2 all', '2 4', '2 2', '1 2', '0 2']);
  assert.equal(headset.fovea.strength, 1);
  assert.deepEqual(headset.run(10, 120), ['0 2', '1 2', '2 2', '2 4', '2 all']);
});

test('a file without a ladder has its tiers, one without tiers nothing, and a pinned rung is whole', () => {
  const tiers = new Headset(new Ladder(), [{ tier: 1 }, { tier: 0 }, { tier: 1 }]);
  assert.deepEqual(tiers.run(40, 10), ['0 all', '0 1']);
  assert.deepEqual(new Headset(new Ladder(), [{ tier: 0 }]).run(40, 10), ['0 all']);
  const ladder = new Ladder(RUNGS),
    headset = new Headset(ladder);
  headset.run(40, 1.5);
  assert.equal(headset.fovea.edge.tier, 4);
  ladder.pinned = 1;
  headset.run(40, 1);
  assert.deepEqual([headset.fovea.edge, headset.fovea.strength], [null, 0]);
  ladder.pinned = null;
  headset.run(40, 0.1);
  assert.ok(headset.fovea.edge !== null, 'unpinned, it is as slow as before');
});

test('an order leaves out the higher tiers outside the middle, unless their footprint reaches it', () => {
  const m = view([0.4, 0.3, -3], 100, 100, 50).cameraFromWorld,
    edge = { inner: 0.2, tier: 1 },
    pages = [0, 1].map((tier) => page(tier, 600, { from: 0, to: 1, tier, logScale: [-6, -1] })),
    sorter = new Sorter();
  for (const { page: made, entry } of pages) sorter.add({ ...made, ...entry, row: made.id });
  const sort = (fovea) => {
    const { orders: [{ order, count }], left } = sorter.orders({ time: 0.5, views: [m], near: 0.01, fovea });
    return { ids: [...order.subarray(0, count)], left };
  };
  const whole = sort(null),
    thin = sort(edge),
    p = new Float64Array(11);
  let [gone, reached] = [0, 0];
  const expected = whole.ids.filter((id) => {
    const { page: made } = pages[id >> 10],
      i = id & 1023;
    if (made.id < edge.tier) return true;
    path(made.words, made.headers, i, 1, p);
    const at = [0, 1, 2].map((k) => p[k] + p[4 + k] * (0.5 - p[3])),
      [x, y, z] = [0, 4, 8].map((r) => m[r] * at[0] + m[r + 1] * at[1] + m[r + 2] * at[2] + m[r + 3]);
    const h = made.headers.subarray(24 * (i >> 8)),
      code = Math.max(...[0, 8, 16].map((bit) => (made.words[8 * i + 2] >>> bit) & 255)),
      sigma = Math.exp(h[10] + ((h[11] - h[10]) * code) / 255),
      beyond = Math.hypot(x, y) - edge.inner * z;
    if (beyond > 0 && beyond <= 3.3 * sigma) reached++;
    if (beyond > 3.3 * sigma) gone++;
    return beyond <= 3.3 * sigma;
  });
  assert.ok(gone > 50 && reached > 20, `${gone} left out, ${reached} reach the middle`);
  assert.deepEqual(thin.ids, expected);
  assert.deepEqual([thin.left, whole.left], [gone, 0]);
});

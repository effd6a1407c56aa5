// What the stream requests and lets go of, with a recorded file and backend.

import assert from 'node:assert/strict';
import test from 'node:test';
import { SceneFile } from '../../player/scene-file.js';
import { Stream } from '../../player/stream.js';
import { sample } from './sample.mjs';
import { serve } from './server.mjs';

/// A file of `segments` one-second pages of 1,000 Gaussians and a root of two tiers; pages arrive when `arrive` is
/// called this way.
/// `masks`: page k has key masks, of 5,000 bytes, in section 100 + k.
function recorded(segments = 20, root = 2, masks = false) {
  const own = (id) => (masks ? { mask: 100 + id, maskBytes: 5000 } : {});
  const entry = (id, from, to, tier) => ({ id, from, to, tier, count: 1000, palette: -1, ...own(id) });
  const pages = [...Array(root).keys()].map((i) => entry(i, 0, segments, i));
  for (let i = 0; i < segments; i++) pages.push(entry(root + i, i, i + 1, 0));
  const asked = [],
    open = new Map(),
    bad = new Set();
  const clamp = (t) => Math.min(Math.max(t, 0), segments - 1e-9);
  const get = (id, { signal }) =>
    new Promise((resolve, reject) => {
      asked.push(id);
      if (bad.has(id)) return reject(new Error(`section ${id}`));
      open.set(id, () => (open.delete(id), resolve({ id })));
      signal.addEventListener('abort', () => (open.delete(id), reject(signal.reason)));
    });
  const file = {
    meta: { clip: [0, segments - 1e-9] },
    sections: pages,
    pages,
    clamp,
    activePages: (t) => pages.filter((p) => p.from <= clamp(t) && clamp(t) < p.to),
    page: get,
    mask: get,
  };
  const there = new Set();
  // Of a page and its mask, only both together may go, and no mask may come before its page.
  const backend = {
    addPage: ({ id }) => there.add(id),
    addMask: (id, mask) => (assert.ok(there.has(id) && mask.id === 100 + id), there.add(mask.id)),
    dropPage: (id) => (there.delete(id), there.delete(100 + id)),
  };
  const tick = () => new Promise((done) => setTimeout(done, 0));
  const arrive = async () => {
    for (const go of [...open.values()]) go();
    await tick();
  };
  const all = async () => {
    while (open.size) await arrive();
  };
  return { file, backend, there, asked, open, bad, tick, arrive, all };
}

test('a seek requests its own time first, by tier, then later ones', async () => {
  const r = recorded(),
    stream = new Stream(r.file, r.backend);
  stream.update(5.5);
  assert.deepEqual(r.asked, [0, 7, 1]);
  assert.equal(stream.ready(5.5), 0);
  await r.arrive();
  assert.equal(stream.ready(5.5), 1);
  // Half a second to both sides.
  assert.deepEqual(
    r.asked.slice(3).sort((a, b) => a - b),
    [6, 8],
  );
  stream.update(15.2);
  assert.deepEqual(r.asked.slice(5), [17], 'only the new segment');
  assert.deepEqual([...r.open.keys()], [17], 'and what is no longer wanted is stopped');
  await r.all();
  assert.ok(stream.ready(15.2) === 1);
});

test('playing prefetches two seconds, in its direction and around the loop', async () => {
  for (const [time, speed, ahead] of [
    [3.1, 1, [6, 7]],
    [18.5, 1, [21, 2]],
    [10.5, 2, [13, 14, 15, 16]],
    [10.5, -1, [11, 10]],
  ]) {
    const r = recorded(),
      stream = new Stream(r.file, r.backend);
    stream.update(time, { playing: true, speed });
    await r.all();
    assert.deepEqual(
      r.asked.slice(3).filter((id) => ahead.includes(id)),
      ahead,
      `${time} at ${speed}`,
    );
    assert.ok(r.asked.length <= 3 + ahead.length + 1, `${r.asked}`);
  }
});

test('nothing is requested twice, and an unchanged time costs nothing', async () => {
  const r = recorded(),
    stream = new Stream(r.file, r.backend);
  for (let i = 0; i < 100; i++) stream.update(4.5 + i * 1e-4);
  await r.all();
  for (let i = 0; i < 100; i++) stream.update(4.5 + i * 1e-4);
  assert.equal(new Set(r.asked).size, r.asked.length);
});

test('above the budget the farthest pages are dropped, never the current ones; too small a budget drops lower tiers', async () => {
  const r = recorded(),
    stream = new Stream(r.file, r.backend, { budget: 8 * 32_000 });
  for (let t = 0.5; t < 20; t++) {
    stream.update(t, { playing: true });
    await r.all();
    assert.equal(stream.ready(t), 1, `${t}`);
    assert.ok(r.there.size <= 8 && stream.bytes <= 8 * 32_000);
  }
  assert.equal(stream.left, 0);
  const small = recorded(),
    told = [],
    tight = new Stream(small.file, small.backend, { budget: 2 * 32_000, onleft: (n) => told.push(n) });
  for (let t = 0.5; t < 20; t++) {
    tight.update(t, { playing: true });
    await small.all();
    assert.deepEqual(
      [...small.there].sort((a, b) => a - b),
      [0, 2 + Math.floor(t)],
    );
    await tight.settled(t);
    assert.equal(tight.left, small.file.activePages(t).reduce((n, p) => n + p.count, 0) - 2000);
  }
  assert.deepEqual(told, [tight.left], 'said once');
  const none = recorded(),
    nothing = new Stream(none.file, none.backend, { budget: 10 });
  await nothing.settled(3);
  assert.equal(none.there.size, 0);
});

test('a failing page is retried, then reported; the others continue', async () => {
  const r = recorded(),
    errors = [],
    stream = new Stream(r.file, r.backend, { onerror: (e) => errors.push(e.message) });
  r.bad.add(7);
  const settled = stream.settled(5.5);
  await r.tick();
  await r.all();
  await settled;
  assert.deepEqual(errors, ['section 7']);
  assert.equal(r.asked.filter((id) => id === 7).length, 2);
  assert.ok(r.there.has(0) && r.there.has(1) && r.there.has(8));
  assert.equal(stream.ready(5.5), 2 / 3);
});

test('an image is complete when the coarsest tier of every span is loaded or failed', async () => {
  const r = recorded(),
    stream = new Stream(r.file, r.backend);
  stream.update(5.5);
  assert.equal(stream.playable(5.5), false);
  // The root alone, half of all Gaussians and more, lacks what moves.
  for (const id of [0, 1]) r.open.get(id)();
  await r.tick();
  assert.deepEqual([stream.playable(5.5), stream.ready(5.5)], [false, 2 / 3]);
  r.open.get(7)();
  await r.tick();
  assert.deepEqual([stream.playable(5.5), stream.playable(6.5), stream.playable(15.5)], [true, false, false]);
  await r.all();
  assert.deepEqual([stream.playable(6.5), stream.playable(4.5)], [true, true], 'what lies ahead is asked in advance');
  const fine = recorded(),
    coarse = new Stream(fine.file, fine.backend);
  coarse.update(5.5);
  for (const id of [0, 7]) fine.open.get(id)();
  await fine.tick();
  assert.equal(coarse.playable(5.5), true, 'finer tiers may come later');
  const failing = recorded(),
    given = new Stream(failing.file, failing.backend);
  failing.bad.add(7);
  const settled = given.settled(5.5);
  await failing.tick();
  await failing.all();
  await settled;
  assert.equal(given.playable(5.5), true, 'a page that fails does not stop the clock for ever');
  const small = recorded(),
    tight = new Stream(small.file, small.backend, { budget: 32_000 });
  tight.update(5.5);
  await small.all();
  assert.equal(tight.playable(5.5), true, 'nor one that the budget has no room for');
});

test('masks are requested with their pages, which do not wait for them', async () => {
  const r = recorded(20, 2, true),
    stream = new Stream(r.file, r.backend);
  stream.update(5.5);
  assert.deepEqual(r.asked, [0, 100, 7, 107, 1, 101]);
  let settled = false;
  stream.settled(5.5).then(() => (settled = true));
  // A mask before its page, a page before its mask.
  for (const id of [107, 0, 1, 101]) r.open.get(id)();
  await r.tick();
  assert.deepEqual([...r.there], [0, 1, 101]);
  assert.deepEqual([stream.ready(5.5), settled], [2 / 3, false]);
  r.open.get(7)();
  await r.tick();
  assert.deepEqual([...r.there], [0, 1, 101, 7, 107]);
  assert.deepEqual([stream.ready(5.5), settled], [1, false]);
  assert.equal(r.asked.length, 6, 'this moment first');
  r.open.get(100)();
  await r.tick();
  assert.ok(settled && r.there.has(100));
  await r.all();
  assert.equal(stream.bytes, 37_000 * (r.there.size / 2));
  assert.equal(new Set(r.asked).size, r.asked.length);
});

test('a stopped or failed mask is requested again, its page is not', async () => {
  const r = recorded(20, 2, true),
    errors = [],
    stream = new Stream(r.file, r.backend, { onerror: (e) => errors.push(e.message) });
  stream.update(5.5);
  r.open.get(7)();
  await r.tick();
  // Elsewhere, and back.
  stream.update(15.5);
  await r.tick();
  assert.ok(!r.open.has(107) && r.there.has(7));
  stream.update(5.5);
  assert.deepEqual(r.asked.slice(-1), [107]);
  r.bad.add(117);
  await r.all();
  assert.ok(r.there.has(107) && !errors.length);
  const settled = stream.settled(15.5);
  await r.all();
  await settled;
  assert.deepEqual(errors, ['section 117']);
  assert.equal(r.asked.filter((id) => id === 17).length, 2, 'once stopped, once fetched');
  assert.equal(r.asked.filter((id) => id === 117).length, 3);
  assert.equal(stream.ready(15.5), 1, 'the page is shown without it');
});

test('a budget holds pages with their masks', async () => {
  const r = recorded(20, 2, true),
    stream = new Stream(r.file, r.backend, { budget: 5 * 37_000 });
  for (let t = 0.5; t < 20; t++) {
    stream.update(t, { playing: true });
    await r.all();
    assert.equal(stream.ready(t), 1, `${t}`);
    assert.ok(r.there.size <= 10 && stream.bytes <= 5 * 37_000);
  }
});

test('a palette is loaded before its page, and requested once', async () => {
  const { bytes } = sample({ scale: 5, codec: 0 }),
    server = await serve({ files: { a: bytes } });
  try {
    const file = await SceneFile.open(server.url + 'a'),
      palettes = [],
      done = [];
    const stream = new Stream(file, {
      addPalette: ({ id }) => palettes.push(id),
      addPage: ({ id }, entry) => done.push(id) && assert.ok(entry.palette < 0 || palettes.includes(entry.palette)),
      dropPage: () => {},
    });
    await stream.settled(3.5);
    assert.deepEqual(done.toSorted(), [4, 5, 7]);
    assert.equal(stream.ready(3.5), 1);
    stream.destroy();
  } finally {
    await server.close();
  }
});

test('the first frame and a seek fetch only their own bytes', async () => {
  const { bytes } = sample({ scale: 8, codec: 0 });
  const server = await serve({ files: { a: bytes } });
  try {
    const file = await SceneFile.open(server.url + 'a');
    const head = server.sent;
    const backend = { addPalette: () => {}, addPage: () => {}, dropPage: () => {} };
    // No room for more than the fullest time: nothing is fetched ahead, so that every byte can be accounted for.
    const stream = new Stream(file, backend, { budget: 32 * 8 * (700 + 1025 + 511) });
    const outside = (ids) =>
      ids.reduce(
        (n, id) =>
          n +
          Math.max(0, file.sections[id].offset + file.sections[id].stored - Math.max(head, file.sections[id].offset)),
        0,
      );
    await stream.settled(4.5);
    const first = server.sent;
    // Both tiers of the root, the third second's page (8), and the palette of all three (0).
    assert.equal(first - head, outside([0, 4, 5, 8]));
    await stream.settled(3.5);
    assert.equal(server.sent - first, outside([7]));
    assert.equal(file.bytesRead, server.sent);
    stream.destroy();
  } finally {
    await server.close();
  }
});

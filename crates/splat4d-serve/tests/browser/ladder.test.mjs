// The choice of the rung of a bitrate ladder, with recorded numbers: the throughput of a connection, the frames of a
// device, and what the stream requests. In a browser: ladder-play.test.mjs.

import assert from 'node:assert/strict';
import test from 'node:test';
import { Ladder, Throughput, rungOf } from '../../player/ladder.js';
import { Stream } from '../../player/stream.js';

const RUNGS = [8, 20, 75].map((megabits, k) => ({ rate: 1e6 * megabits, tiers: [2, 3, 5][k] }));
const ladder = () => new Ladder(RUNGS);
const steer = (l, now, megabits, more = {}) => (l.steer(now, { rate: 1e6 * megabits, ...more }), l.wanted);

test('throughput counts busy time only, and follows a connection that becomes slower at once', () => {
  const t = new Throughput();
  assert.equal(t.rate(0), 0);
  let now = 0;
  // 1.25 MB/s in pieces of 50 ms, with pauses of a second between requests that overlap.
  for (let i = 0; i < 8; i++, now += 1000) {
    t.begin(now);
    t.begin(now + 10);
    for (let k = 0; k < 8; k++) t.add(62_500, (now += 50));
    t.end(now);
    t.end(now);
  }
  assert.ok(Math.abs(t.rate(now) / 1e7 - 1) < 0.05, `${t.rate(now)}`);
  t.begin(now);
  for (let k = 0; k < 20; k++) t.add(12_500, (now += 50));
  assert.ok(t.rate(now) < 2.3e6, `${t.rate(now)}`);
  t.end(now);
  for (let k = 0; k < 3; k++) {
    t.begin(now);
    for (let i = 0; i < 40; i++) t.add(62_500, (now += 50));
    t.end(now);
  }
  assert.ok(t.rate(now) > 9e6, 'and rises again');
  t.begin(now);
  const silent = t.rate(now + 5000);
  assert.ok(silent < 2e6, `a connection that is silent for 5 s is slow: ${silent}`);
});

test('times of the browser count instead of those of a page that reads late', () => {
  const t = new Throughput();
  t.begin(0);
  t.add(125_000, 900);
  t.end(900);
  // Two requests that overlap: 125,000 bytes in 100 ms.
  t.timed(60_000, 0, 0, 80);
  t.timed(65_000, 20, 20, 100);
  assert.ok(Math.abs(t.rate(900) / 1e7 - 1) < 0.01, `${t.rate(900)}`);
  // Every answer begins after 100 ms, then brings 62,500 bytes in 50 ms.
  const late = new Throughput();
  for (let at = 0; at < 2000; at += 200) late.timed(62_500, at, at + 100, at + 150);
  assert.ok(Math.abs(late.rate(2000) / 1e7 - 1) < 0.01, `${late.rate(2000)}`);
});

test('a small first answer is measured, but not its latency alone', () => {
  const t = new Throughput();
  t.begin(0);
  t.add(2000, 150);
  t.end(150);
  assert.equal(t.rate(150), 0);
  t.begin(200);
  t.add(65_536, 252);
  t.end(252);
  assert.ok(t.rate(252) > 2e6);
});

test('the rung follows the throughput: down at once, up when it is calm', () => {
  const l = ladder();
  assert.deepEqual([l.wanted, l.reason], [0, 'start']);
  assert.equal(steer(l, 0, 0), 0, 'nothing is measured yet');
  assert.equal(steer(l, 100, 30), 1, 'the first measurement counts at once');
  assert.equal(l.reason, 'connection');
  assert.equal(steer(l, 200, 21.5), 1, 'kept while it just fits');
  assert.equal(steer(l, 300, 12), 0);
  assert.equal(steer(l, 400, 200), 0, 'no way up so soon');
  assert.equal(steer(l, 4000, 200), 2);
  assert.deepEqual([l.wanted, l.reason], [2, 'whole']);
  assert.equal(steer(l, 8000, 200, { speed: 4 }), 1, 'four times the speed needs four times the bytes');
  assert.equal(steer(l, 12_000, Infinity), 2, 'what is in memory is whole');
});

test('a clock that waits for pages takes the lowest rung', () => {
  const l = ladder();
  assert.equal(steer(l, 0, 30), 1);
  assert.equal(steer(l, 1000, 30, { waiting: true }), 1, 'a moment of waiting is a seek');
  assert.equal(steer(l, 1500, 30, { waiting: true }), 0);
});

/// Frames of `ms` each for so many seconds, from `now` on; returns when they end.
function frames(l, now, seconds, ms, options) {
  for (const end = now + 1000 * seconds; now < end; now += ms) l.frame(ms, now, l.wanted, options);
  return now;
}

test('a slow device drops a rung, and tries it again later and later', () => {
  const l = ladder();
  l.steer(0, { rate: Infinity });
  let now = frames(l, 0, 1.9, 60);
  assert.deepEqual([l.wanted, l.cap, l.reason], [1, 1, 'device']);
  now = frames(l, now, 4, 16);
  assert.equal(l.cap, 1, 'not at once');
  now = frames(l, now, 6, 16);
  assert.equal(l.cap, 2, 'but after some calm seconds');
  now = frames(l, now, 1, 60);
  assert.equal(l.cap, 1);
  now = frames(l, now, 10, 16);
  assert.equal(l.cap, 1, 'the second time later');
  now = frames(l, now, 10, 16);
  assert.equal(l.cap, 2);
  now = frames(l, now, 10, 60);
  assert.equal(l.cap, 0, 'down to the lowest');
  const whole = ladder();
  whole.steer(0, { rate: Infinity });
  frames(whole, 0, 5, 60, { stuck: false });
  assert.equal(whole.cap, 2, 'while fewer pixels may help, no rung is dropped');
  const short = ladder();
  short.steer(0, { rate: Infinity });
  frames(short, 0, 0.5, 60);
  assert.equal(short.cap, 2, 'a few slow frames are none');
});

test('a pinned rung ignores connection and device', () => {
  const l = ladder();
  l.pinned = 1;
  l.steer(0, { rate: 1 });
  frames(l, 0, 5, 100);
  assert.deepEqual([l.wanted, l.cap, l.reason], [1, 1, 'pinned']);
  l.pinned = null;
  assert.equal(l.wanted, 0);
  assert.deepEqual(['auto', '1', '3', '0', '', null, 'x', 2].map(rungOf), [null, 0, 2, null, null, null, null, 1]);
  const none = new Ladder([]);
  none.pinned = 3;
  assert.deepEqual([none.length, none.wanted, none.tiers(0)], [1, 0, Infinity], 'a file without a ladder is whole');
});

/// A clip of 10 s with a page for each second and tier 0 to 3; rungs are tiers 0, 1 and 2 to 3. `rate()`: bits per
/// second of its connection.
function recorded(rate) {
  const pages = [];
  for (let s = 0; s < 10; s++) {
    for (let tier = 0; tier < 4; tier++) {
      pages.push({ id: 4 * s + tier, from: s, to: s + 1, tier, count: 1000, palette: -1 });
    }
  }
  const asked = [],
    open = new Map(),
    there = new Set();
  const clamp = (t) => Math.min(Math.max(t, 0), 10 - 1e-9);
  const file = {
    meta: { clip: [0, 10 - 1e-9], ladder: RUNGS.map((r, k) => ({ ...r, tiers: [1, 2, 4][k] })) },
    sections: pages,
    pages,
    clamp,
    rate,
    activePages: (t) => pages.filter((p) => p.from <= clamp(t) && clamp(t) < p.to),
    page: (id, { signal }) =>
      new Promise((resolve, reject) => {
        asked.push(id);
        open.set(id, () => (open.delete(id), resolve({ id })));
        signal.addEventListener('abort', () => (open.delete(id), reject(signal.reason)));
      }),
  };
  const backend = { addPage: ({ id }) => there.add(id), dropPage: (id) => there.delete(id) };
  const arrive = async () => {
    for (const go of [...open.values()]) go();
    await new Promise((done) => setTimeout(done, 0));
  };
  const all = async () => {
    while (open.size) await arrive();
  };
  return { file, backend, asked, there, open, arrive, all };
}

test('the lowest rung comes first, that of the next seconds before more of this one; the rest while idle', async () => {
  const r = recorded(() => 30e6),
    stream = new Stream(r.file, r.backend);
  stream.update(2.5, { playing: true });
  assert.deepEqual(r.asked, [8], 'the lowest rung of now alone');
  assert.equal(stream.playable(2.5), false);
  await r.arrive();
  assert.equal(stream.playable(2.5), true, 'no higher rung is waited for');
  assert.deepEqual(r.asked.slice(1, 5), [12, 16, 9, 13], 'the lowest of the next two seconds, then the chosen rung');
  assert.deepEqual(stream.rungs(2.5), { rung: 1, chosen: 2, limit: 3, rungs: 3, reason: 'connection', rate: 20, leftOut: 3000 });
  await r.arrive();
  assert.equal(stream.rungs(2.5).rung, 2);
  await r.all();
  assert.deepEqual(
    r.asked.slice(-6).toSorted((a, b) => a - b),
    [10, 11, 14, 15, 18, 19],
    'pages of the highest rung come while nothing else does',
  );
  assert.deepEqual([stream.rungs(2.5).rung, stream.rungs(2.5).leftOut], [3, 0]);
  stream.destroy();
});

test('a pinned rung has exactly its pages, and drops the others', async () => {
  const r = recorded(() => Infinity),
    stream = new Stream(r.file, r.backend);
  await Promise.all([stream.settled(4.5), r.all()]);
  assert.ok([16, 17, 18, 19].every((id) => r.there.has(id)));
  stream.ladder.pinned = 0;
  stream.update(4.5);
  await r.all();
  assert.ok([...r.there].every((id) => id % 4 === 0) && r.there.has(16), `${[...r.there]}`);
  assert.equal(stream.ready(4.5), 1);
  stream.ladder.pinned = 1;
  await Promise.all([stream.settled(4.5), r.all()]);
  assert.ok(r.there.has(17) && !r.there.has(18));
  stream.destroy();
});

test('a slower connection stops pages of higher rungs that are on their way', async () => {
  let rate = 200e6;
  const r = recorded(() => rate),
    stream = new Stream(r.file, r.backend);
  stream.update(2.5, { playing: true });
  await r.arrive();
  await r.arrive();
  assert.ok([...r.open.keys()].some((id) => id % 4 > 0), `${[...r.open.keys()]}`);
  rate = 5e6;
  await new Promise((done) => setTimeout(done, 250));
  stream.update(3.6, { playing: true });
  await new Promise((done) => setTimeout(done, 0));
  assert.ok([...r.open.keys()].every((id) => id % 4 === 0), `${[...r.open.keys()]}`);
  assert.equal(stream.ladder.wanted, 0);
  await r.all();
  stream.destroy();
});

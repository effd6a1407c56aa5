// Which orders are requested and which are rendered, with a recorded order and a clock of the test's own.

import assert from 'node:assert/strict';
import test from 'node:test';
import { Follower, Schedule, advance, sorted } from '../../player/schedule.js';

const CLIP = { first: 0, last: 1, frameTime: 0.1, loop: true };
const VIEW = { cameraFromWorld: Float64Array.from([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]), width: 4, height: 3 };
const close = (a, b, by = 1e-9) => assert.ok(Math.abs(a - b) <= by, `${a} is not ${b}`);

/// An order that takes `ms`, a clock that plays, and frames every `frame` ms.
class Machine {
  now = 0;
  start = 0;
  speed = 1;
  playing = true;
  epoch = 0;
  view = VIEW;
  /// Times that were requested, and [now, time] of what was rendered.
  asked = [];
  rendered = [];
  order = {
    busy: false,
    generation: 1,
    ask: (time) => {
      this.order.busy = true;
      this.asked.push(time);
      this.due = this.now + this.ms;
    },
  };
  schedule = new Schedule(this.order);

  constructor({ ms = 1, frame = 16, clip = CLIP } = {}) {
    Object.assign(this, { ms, frame, clip });
  }

  /// The clock at `ms`.
  at = (ms) => Math.min(advance(this.start, ((ms - (this.began ?? 0)) / 1000) * this.speed, this.clip).time, this.clip.last);

  seek(time) {
    this.start = time;
    this.began = this.now;
    this.epoch++;
  }

  pause() {
    this.seek(this.schedule.shown.time);
    this.playing = false;
  }

  /// Orders that come until `until`.
  #arrive(until) {
    while (this.order.busy && this.due <= until) {
      this.now = this.due;
      this.order.busy = false;
      this.schedule.arrived(this.now);
      this.schedule.ask(this.now);
    }
  }

  frames(n) {
    for (; n > 0; n--) {
      const next = this.now - (this.now % this.frame) + this.frame;
      this.#arrive(next);
      this.now = next;
      const { playing, epoch, view } = this;
      this.schedule.want({ time: this.at(playing ? this.now : this.began), at: playing ? this.at : null, epoch, view }, this.now);
      if (this.schedule.fresh) {
        this.schedule.rendered(this.now);
        this.rendered.push([this.now, this.schedule.shown.time]);
      }
      this.schedule.ask(this.now);
    }
    return this;
  }
}

test('a clock runs to the end of its last frame, then stops or begins again', () => {
  close(advance(0.5, 0.25, CLIP).time, 0.75);
  close(advance(1, 0.05, CLIP).time, 1.05);
  close(advance(1.05, 0.1, CLIP).time, 0.05);
  close(advance(0.2, 2.3, CLIP).time, 0.3);
  assert.deepEqual(advance(0.9, 0.25, { ...CLIP, loop: false }), { time: 1, ended: true });
  assert.deepEqual(advance(0.25, 0.25, { ...CLIP, loop: false }), { time: 0.5, ended: false });
  const late = { first: 5, last: 6, frameTime: 0.1, loop: true };
  close(advance(5.9, 0.3, late).time, 5.1);
});

test('orders are requested ahead by the measured latency, so that playing is in time on average', () => {
  // A fast device, a slow one, a slow sort on a fast device, and faster than life.
  for (const [ms, frame, speed] of [[1, 16, 1], [5, 200, 1], [50, 16, 1], [5, 200, 4]]) {
    const m = new Machine({ ms, frame, clip: { ...CLIP, last: 1000 } });
    m.speed = speed;
    m.frames(200);
    const late = m.rendered.slice(20).map(([now, time]) => (now / 1000) * speed - time);
    const mean = late.reduce((a, b) => a + b) / late.length;
    close(mean, 0, (0.01 + 0.02 * frame / 1000) * speed);
    const steps = m.rendered.slice(1).map(([, time], i) => time - m.rendered[i][1]);
    assert.ok(steps.every((s) => s > 0), 'never back');
  }
});

test('slow sorting goes on while frames are rendered', () => {
  const m = new Machine({ ms: 40, frame: 16, clip: { ...CLIP, last: 1000 } }).frames(100);
  // An order each 40 ms, not each third frame.
  assert.ok(m.rendered.length >= 36, `${m.rendered.length} of 100 frames`);
});

test('requests beyond the end wrap to the beginning', () => {
  const m = new Machine({ ms: 5, frame: 100 });
  m.frames(40);
  const times = m.rendered.slice(10).map(([, time]) => time);
  assert.ok(times.some((t, i) => t < (times[i - 1] ?? 0)), 'it begins again');
  // One loop lasts 1.1 s: eleven frames of 0.1 s, one of them the last frame's.
  for (const [now, time] of m.rendered.slice(10)) {
    const late = (now / 1000 - time + 1.1) % 1.1;
    // The clock continues while the last frame is shown.
    assert.ok(late < 0.02 || late > 1.08 || (time === 1 && late < 0.12), `${time} at ${now} ms`);
  }
});

test('an order that was requested ahead is not rendered after a pause or a seek', () => {
  const m = new Machine({ ms: 30, frame: 16 }).frames(20);
  while (!m.order.busy) m.frames(1);
  const { time } = m.schedule.shown,
    count = m.rendered.length;
  m.pause();
  m.frames(20);
  assert.deepEqual(m.rendered.slice(count), [], 'the image stays');
  assert.deepEqual(m.schedule.shown, { time, epoch: m.epoch });
  // Nor one that has come and waits for the next frame.
  const quick = new Machine({ ms: 1, frame: 16 }).frames(20),
    shown = quick.schedule.shown.time;
  quick.order.busy = false;
  quick.schedule.arrived(quick.now);
  assert.ok(quick.schedule.fresh);
  quick.pause();
  quick.frames(3);
  assert.equal(quick.rendered.at(-1)[1], shown);
  const played = new Machine({ ms: 30, frame: 16 }).frames(20);
  while (!played.order.busy) played.frames(1);
  const before = played.rendered.length;
  played.seek(0.75);
  played.frames(8);
  const [, first] = played.rendered[before];
  assert.ok(first >= 0.75 && first < 0.9, `the next image is that of the seek: ${first}`);
  assert.equal(played.schedule.shown.epoch, played.epoch);
});

test('a clock that keeps jumping is followed', () => {
  // Dragging the slider while sorting is slow: paused, and while it plays.
  for (const playing of [false, true]) {
    const m = new Machine({ ms: 50, frame: 16 });
    m.playing = playing;
    m.frames(8);
    const before = m.rendered.length;
    for (let i = 0; i < 60; i++) {
      m.seek(i / 60);
      m.frames(1);
    }
    assert.ok(m.rendered.length - before >= 8, `${m.rendered.length - before} images`);
    m.playing = false;
    m.seek(0.5);
    m.frames(20);
    assert.equal(m.schedule.shown.time, 0.5);
    assert.equal(m.order.busy, false, 'and then nothing is computed');
  }
});

test('nothing is requested for a time whose pages are missing', () => {
  const m = new Machine({ ms: 1, frame: 16 });
  const at = m.at;
  m.at = (ms) => ((t) => (t >= 0.5 ? null : t))(at(ms));
  m.frames(60);
  assert.ok(m.asked.every((t) => t < 0.5) && m.schedule.shown.time < 0.5 && m.schedule.shown.time > 0.45);
});

test('a new page or a moved camera requests an order, at rest nothing does', () => {
  const m = new Machine();
  m.playing = false;
  m.frames(5);
  assert.equal(m.asked.length, 1);
  m.order.generation++;
  m.frames(5);
  assert.equal(m.asked.length, 2);
  m.view = { ...VIEW, cameraFromWorld: Float64Array.from([0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0]) };
  // Turned by a quarter: until its own order arrives, the image keeps the camera of the previous order.
  assert.equal(m.schedule.viewOf(m.view), VIEW);
  m.frames(5);
  assert.equal(m.asked.length, 3);
  assert.equal(m.schedule.viewOf(m.view), m.view);
  const nudged = { ...m.view, cameraFromWorld: m.view.cameraFromWorld.map((x, k) => (k === 3 ? x + 9 : x)) };
  assert.equal(m.schedule.viewOf(nudged), nudged, 'any other camera is the newest');
});

test('an order of the previous scene is not rendered', () => {
  const m = new Machine({ ms: 30 });
  m.frames(1);
  assert.ok(m.order.busy);
  m.order.generation++;
  m.schedule.reset();
  m.order.busy = false;
  assert.equal(m.schedule.arrived(m.now), false);
  assert.deepEqual([m.schedule.current, m.schedule.shown], [null, null]);
});

test('one slow frame does not send the clock far ahead', () => {
  const m = new Machine({ ms: 1, frame: 16, clip: { ...CLIP, last: 1000 } }).frames(40);
  m.frame = 800;
  m.frames(1);
  m.frame = 16;
  m.frames(20);
  for (const [now, time] of m.rendered.slice(-15)) assert.ok(time - now / 1000 < 0.03, `${time} at ${now} ms`);
});

test('eyes with parallel axes have one order, canted ones an order each', () => {
  /// An eye that is turned by `degrees` about y, `x` to the right.
  const eye = (degrees, x) => {
    const [c, s] = [Math.cos, Math.sin].map((f) => f((degrees * Math.PI) / 180));
    return { cameraFromWorld: Float64Array.from([c, 0, s, -x, 0, 1, 0, 0, -s, 0, c, 0]) };
  };
  const parallel = [eye(0, -0.03), eye(0, 0.03)],
    canted = [eye(-2.5, -0.03), eye(2.5, 0.03)];
  assert.deepEqual(sorted(parallel), [parallel[0]]);
  assert.deepEqual(sorted(canted), canted);
  assert.deepEqual(sorted([eye(0, 0)]).length, 1);
  const requests = [],
    schedule = new Schedule({ busy: false, generation: 1, ask: (time, views) => requests.push(views.length) });
  for (const eyes of [parallel, canted]) {
    schedule.want({ time: 0, at: null, epoch: 0, view: eyes[0], eyes }, 0);
    schedule.ask(0);
    schedule.arrived(1);
    assert.equal(schedule.ask(2), false, 'nothing moved: no order is requested');
  }
  assert.deepEqual(requests, [1, 2]);
});

test("a page's own clock is predicted: its speed, its loop, and that it stops", () => {
  const clip = [0, 1],
    f = new Follower();
  const set = (time, now) => f.set(time, now, clip);
  set(0, 0);
  assert.equal(f.at(clip), null);
  for (let i = 1; i <= 9; i++) set(i / 10, 100 * i);
  close(f.at(clip)(950), 0.95);
  close(f.at(clip)(1100), 1, 1e-9);
  // A second view of the same frame changes nothing; it begins again.
  set(0.9, 900.5);
  const before = f.epoch;
  set(0, 1000);
  assert.equal(f.epoch, before + 1);
  for (let i = 1; i <= 9; i++) set(i / 10, 1000 + 100 * i);
  close(f.at(clip)(2050), 0.05);
  set(0, 2000);
  assert.equal(f.epoch, before + 1, 'what was requested for the beginning is good');
  // Stopped, and later set by hand.
  set(0, 2100);
  assert.equal(f.at(clip), null);
  assert.equal(f.epoch, before + 2);
  set(0.7, 9000);
  assert.equal(f.at(clip), null);
  // A jump ahead is no speed.
  set(0.1, 9100);
  set(0.2, 9200);
  assert.notEqual(f.at(clip), null);
  set(0.99, 9210);
  assert.equal(f.at(clip), null);
});

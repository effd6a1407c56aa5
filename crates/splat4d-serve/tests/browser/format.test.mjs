// The reader against files written from docs/format.md alone, good and hostile. Run: node --test tests/browser/

import assert from 'node:assert/strict';
import test from 'node:test';
import { deflateRawSync } from 'node:zlib';
import { at, gaussian } from './motion.js';
import { SceneError } from '../../player/errors.js';
import { SceneFile } from '../../player/scene-file.js';
import { moved } from './reference.mjs';
import { grown, keyMasks, layout, random, sample } from './sample.mjs';
import { serve } from './server.mjs';

// Loaded by motion.js; a worker is a classic script and exports nothing.
const { KeyMask, Sorter } = globalThis.splat4dSort;

const near = (a, b, tolerance, what) =>
  a.forEach((v, k) => assert.ok(Math.abs(v - b[k]) <= tolerance * (1 + Math.abs(b[k])), `${what} ${k}: ${v} ${b[k]}`));

test('written values are read back at any time', async () => {
  const { bytes, json, truth } = sample();
  const file = await SceneFile.open(new Blob([bytes]));
  assert.equal(file.meta.gaussians, truth.length);
  assert.deepEqual([file.meta.clip, file.meta.fps, file.meta.cameras[0].name], [json.clip, json.fps, 'front']);
  assert.equal(file.sections.length, 10);
  let k = 0;
  for (const entry of file.pages) {
    const page = await file.page(entry.id);
    const palette = entry.palette < 0 ? null : await file.palette(entry.palette);
    for (let i = 0; i < entry.count; i++, k++) {
      const g = gaussian(page, entry, i),
        want = truth[k];
      for (const key of ['mean', 'velocity', 'spin', 'scale', 'quat', 'color'])
        near(g[key], want[key], 1e-5, `${k} ${key}`);
      near([g.center, g.soft, g.opacity], [want.center, want.soft, want.opacity], 1e-5, `${k} life`);
      assert.ok(g.half === want.half || Math.abs(g.half - want.half) < 1e-5 * want.half);
      if (palette) {
        const per = palette.bytes.length / palette.count / 3;
        want.sh.forEach((f, c) =>
          near(
            [0, 1, 2].map(
              (ch) =>
                (palette.ranges[c < 3 ? 0 : c < 8 ? 1 : 2] *
                  (palette.bytes[(3 * c + ch) * palette.count + g.label] - 128)) /
                127,
            ),
            f,
            1e-5,
            `${k} sh ${c}`,
          ),
        );
        assert.equal(want.sh.length, per);
      }
      for (const t of [entry.from, (entry.from + entry.to) / 2]) {
        const now = at(g, t),
          there = moved(want, t);
        assert.equal(now.opacity > 0, there !== null, `${k} at ${t}`);
        if (there) near([...now.mean, now.opacity], [...there.mean, there.opacity], 1e-4, `${k} at ${t}`);
      }
    }
  }
  assert.equal(k, truth.length);
  const poster = await file.poster();
  assert.equal(poster.type, 'image/png');
  assert.equal(poster.size, file.sections[2].bytes);
});

test('key masks select the Gaussians of a time', async () => {
  const { bytes, truth } = sample({ masks: 0.5 });
  const file = await SceneFile.open(bytes);
  let first = 0,
    masked = 0;
  for (const entry of file.pages) {
    const mask = entry.mask < 0 ? null : new KeyMask(await file.mask(entry.mask));
    if (mask) masked++;
    // On key times, between them and outside of all, in mixed order.
    for (const t of [entry.from - 1, entry.from + 0.5, entry.from + 0.25, entry.to - 1e-9, entry.to + 1, entry.from]) {
      const want = truth.slice(first, first + entry.count).map((g) => g.admitted(t));
      const changed = mask?.at(t);
      const got = want.map((_, i) => !mask || ((mask.bits[i >> 5] >>> (i & 31)) & 1) === 1);
      assert.deepEqual(got, want, `page ${entry.id} at ${t}`);
      assert.equal(mask?.count ?? entry.count, want.filter((b) => b).length);
      assert.ok(!mask?.at(t) && changed !== null, 'the same time changes nothing');
    }
    first += entry.count;
  }
  assert.deepEqual([masked, file.pages.length], [5, 6]);
});

test('a file truncated behind a page shows it without its mask', async () => {
  const { bytes } = sample({ masks: 0.5 }),
    whole = await SceneFile.open(bytes);
  const { mask } = whole.pages[0];
  const file = await SceneFile.open(bytes.subarray(0, whole.sections[mask].offset + 5));
  assert.deepEqual([file.pages.length, file.pages[0].mask], [1, -1]);
  await file.page(file.pages[0].id);
});

test('spans select pages, and time is clamped to the clip', async () => {
  const file = await SceneFile.open(sample().bytes);
  const at = (t) => file.activePages(t).map((p) => p.id);
  assert.deepEqual(
    [at(-9), at(2.99), at(3), at(6), at(99)],
    [
      [4, 5, 6],
      [4, 5, 6],
      [4, 5, 7],
      [4, 5, 9],
      [4, 5, 9],
    ],
  );
});

test('ranges are requested once, neighbours together', async () => {
  const { bytes } = sample({ scale: 5, codec: 0 });
  const server = await serve({ files: { 'a.s4d': bytes } });
  try {
    const file = await SceneFile.open(server.url + 'a.s4d');
    assert.equal(file.bytesRead, 65536);
    const [, b, c] = file.pages;
    await Promise.all([file.page(c.id), file.page(b.id)]);
    assert.equal(file.bytesRead, 65536 + b.stored + c.stored);
    await Promise.all(file.pages.slice(3).map((p) => file.page(p.id)));
    assert.equal(file.bytesRead, server.sent);
    const requests = server.log.length;
    assert.ok(requests <= 4, `${requests} requests`);
    const stop = new AbortController(),
      gone = file.page(b.id, { signal: stop.signal });
    stop.abort();
    await assert.rejects(gone, { name: 'AbortError' });
    assert.ok((await file.page(b.id)).words.length === 8 * b.count);
    file.close();
    await assert.rejects(file.page(b.id), { name: 'AbortError' });
  } finally {
    await server.close();
  }
});

test('a long index takes a second request', async () => {
  const title = 'x'.repeat(200_000),
    { bytes } = sample({ json: { title } });
  const server = await serve({ files: { a: bytes } });
  try {
    const file = await SceneFile.open(server.url + 'a');
    assert.equal(file.meta.title, title);
    await file.page(file.pages[0].id);
    assert.equal(file.bytesRead, server.sent);
  } finally {
    await server.close();
  }
});

test('a server without ranges sends the whole file, with progress', async () => {
  const { bytes } = sample({ scale: 5, codec: 0 }),
    server = await serve({ files: { a: bytes }, ranges: false });
  try {
    const seen = [];
    const file = await SceneFile.open(server.url + 'a', { onprogress: (n, all) => seen.push([n, all]) });
    await Promise.all(file.pages.map((p) => file.page(p.id)));
    assert.deepEqual(seen.at(-1), [bytes.length, bytes.length]);
    assert.equal(file.bytesRead, bytes.length);
    assert.equal(server.log.length, 1);
  } finally {
    await server.close();
  }
});

test('a connection that breaks once is tried again, one that stays broken is an error', async () => {
  const { bytes } = sample({ scale: 5, codec: 0 });
  const server = await serve({ files: { a: bytes }, fail: (_, n) => n === 0 || n === 2 });
  try {
    const file = await SceneFile.open(server.url + 'a');
    const last = file.pages.at(-4).id;
    assert.ok((await file.page(last)).count > 0);
    server.options.fail = () => true;
    await assert.rejects(file.page(last), (e) => e instanceof SceneError && /connection/i.test(e.what));
    await assert.rejects(SceneFile.open(server.url + 'a'), SceneError);
    server.options.fail = () => false;
    await assert.rejects(SceneFile.open(server.url + 'b'), (e) => /404/.test(e.message));
  } finally {
    await server.close();
  }
});

test('a truncated file is complete up to its end', async () => {
  const { bytes } = sample();
  const whole = await SceneFile.open(bytes),
    cut = whole.pages[3].offset + 10;
  const file = await SceneFile.open(bytes.subarray(0, cut));
  assert.deepEqual([file.truncated, file.pages.length], [true, 3]);
  for (const p of file.pages) await file.page(p.id);
  await assert.rejects(file.page(whole.pages[3].id), /truncated/);
});

test('a file that grows has its index behind its sections, and reads like a finished one', async () => {
  const { bytes } = sample({ masks: 0.5 }),
    growing = grown(bytes);
  const [a, b] = [await SceneFile.open(bytes), await SceneFile.open(growing)];
  assert.deepEqual([a.growing, b.growing, b.truncated], [false, true, false]);
  assert.deepEqual(a.meta, b.meta);
  for (const { id } of a.pages) assert.deepEqual(await a.page(id), await b.page(id));
  // What was added since the header was written is not looked at, and what is not there yet is reported.
  const more = await SceneFile.open(Buffer.concat([growing, Buffer.alloc(99, 7)]));
  assert.equal(more.pages.length, a.pages.length);
  const gaps = await SceneFile.open(grown(sample({ json: { missing: [[2, 3], [5, 4]] } }).bytes));
  assert.deepEqual(gaps.meta.missing, [[2, 3]]);
  await assert.rejects(SceneFile.open(growing.subarray(0, growing.length - 1)), /truncated in its index/);
});

test('a file that grows is looked at again until it is closed', async () => {
  const growing = grown(sample().bytes),
    longer = Buffer.concat([growing, Buffer.alloc(64)]);
  longer.writeBigUInt64LE(BigInt(longer.length), 16);
  let now = growing,
    calls = 0;
  // A source that is replaced: a Blob's slices are read when they are requested.
  const source = Object.assign(new Blob([growing]), { slice: (a, b) => new Blob([now.subarray(a, b)]) });
  const file = await SceneFile.open(source);
  const called = new Promise((done) => file.watch(() => (calls++, done()), 5));
  await new Promise((done) => setTimeout(done, 40));
  assert.equal(calls, 0, 'it has not grown yet');
  now = longer;
  await called;
  file.close();
  const before = calls;
  await new Promise((done) => setTimeout(done, 40));
  assert.equal(calls, before, 'a closed file is left alone');
  const finished = await SceneFile.open(sample().bytes);
  finished.watch(() => assert.fail('a finished file does not grow'), 1);
  await new Promise((done) => setTimeout(done, 20));
  finished.close();
});

test('hostile and foreign files are refused with a message', async () => {
  const base = sample().json,
    PAGE = (more) => ({
      kind: 'PAGE',
      data: Buffer.alloc(96 + 32),
      codec: 0,
      count: 1,
      words: 8,
      from: 2,
      to: 7,
      ...more,
    });
  const two = keyMasks(() => 0, 1, [2, 3]).data,
    MASK = (more) => ({ kind: 'MASK', data: two, codec: 0, count: 1, page: 0, from: 2, to: 3, ...more });
  const changed = (at, ...bytes) => {
    const data = Buffer.from(two);
    Buffer.from(bytes).copy(data, at);
    return data;
  };
  const patch =
    (at, value, size = 4) =>
    (e) =>
      size === 8 ? e.writeBigUInt64LE(value, at) : size === 2 ? e.writeUInt16LE(value, at) : e.writeUInt32LE(value, at);
  const cases = [
    ['version', layout(base, [PAGE()], { major: 3 })],
    ['no valid "clip"', layout({ ...base, clip: [3, 2] }, [])],
    ['no valid "clip"', layout(null, [])],
    ['no valid "fps"', layout({ ...base, fps: 0 }, [])],
    ['no valid "up"', layout({ ...base, up: [0, 0, 0] }, [])],
    ['no valid "background"', layout({ ...base, background: 'red' }, [])],
    ['does not support', layout(base, [{ kind: 'NEWS', data: Buffer.alloc(4), flags: 1 }])],
    ['outside', layout(base, [PAGE({ patch: patch(8, 1n << 62n, 8) })])],
    ['outside', layout(base, [PAGE({ patch: patch(8, 63n, 8) })])],
    ['overlap', layout(base, [PAGE({ patch: patch(8, 64n, 8) })])],
    ['index is longer', grown(layout(base, [PAGE()]), { at: 1n << 60n })],
    ['index is longer', grown(layout(base, [PAGE()]), { at: 12n })],
    ['overlap', layout(base, [PAGE(), PAGE({ patch: (e) => e.writeBigUInt64LE(e.readBigUInt64LE(8) - 64n, 8) })])],
    ['cannot have', layout(base, [PAGE({ codec: 1, patch: patch(20, 4e9) })])],
    ['cannot have', layout(base, [PAGE({ patch: patch(20, 64) })])],
    ['decodes to', layout(base, [PAGE({ patch: patch(32, 2) })])],
    ['entries', layout(base, [PAGE({ patch: patch(32, 0) })])],
    ['entries', layout(base, [PAGE({ patch: patch(32, 70_000) })])],
    ['method 9', layout(base, [PAGE({ patch: patch(28, 9, 2) })])],
    ['words', layout(base, [PAGE({ words: 9 })])],
    ['time range', layout(base, [PAGE({ from: 3, to: 3 })])],
    ['time range', layout(base, [PAGE({ from: NaN })])],
    ['no palette', layout(base, [PAGE({ palette: 0 })])],
    ['no palette', layout(base, [PAGE({ palette: 77 })])],
    ['refers to no page', layout(base, [PAGE(), MASK({ page: 1 })])],
    ['refers to no page', layout(base, [PAGE(), MASK({ page: 99 })])],
    ['for 2 Gaussians, its page', layout(base, [PAGE(), MASK({ count: 2 })])],
    ['two masks', layout(base, [PAGE(), MASK(), MASK()])],
    ['entries', layout(base, [PAGE(), MASK({ count: 0 })])],
    ['key times', layout(base, [PAGE(), MASK({ data: Buffer.alloc(8) })])],
    ['key times', layout(base, [PAGE(), MASK({ data: Buffer.alloc(25) })])],
    ['key times', layout(base, [PAGE(), MASK({ codec: 1, data: Buffer.alloc(8 + 9 * 65536) })])],
    ['time range', layout(base, [PAGE(), MASK({ from: 4 })])],
    ['time range', layout(base, [PAGE(), MASK({ to: Infinity })])],
    ['cannot have', layout(base, [PAGE(), MASK({ patch: patch(20, 35) })])],
    ['cannot have', layout(base, [PAGE(), MASK({ codec: 1, patch: patch(20, 4e9) })])],
    ['method 2', layout(base, [PAGE(), MASK({ patch: patch(28, 2, 2) })])],
    [
      'decompresses to',
      layout(base, [
        PAGE({ count: 65536, data: Buffer.alloc(256 * 96 + 32 * 65536), codec: 1 }),
        MASK({ count: 65536, codec: 1, data: Buffer.alloc(8 + 10_000 * 8200) }),
      ]),
    ],
    ['degree 4', layout(base, [{ kind: 'PALT', data: Buffer.alloc(12 + 72), count: 1, level: 4 }])],
    ['Not a .s4d', Buffer.from('ply\nformat binary')],
    ['Not a .s4d', Buffer.alloc(0)],
  ];
  for (const [say, bytes] of cases) {
    await assert.rejects(SceneFile.open(bytes), (e) => e instanceof SceneError && e.message.includes(say), say);
  }
  const lazy = [
    ['not finite', PAGE({ data: Buffer.alloc(128, 255) })],
    [
      'palette of 1',
      PAGE({ palette: 1, data: Buffer.alloc(128, 1) }),
      { kind: 'PALT', data: Buffer.alloc(12 + 9), count: 1, level: 1 },
    ],
    ['checksum', PAGE({ patch: patch(24, 1) })],
    ['not a mask of 3', PAGE(), MASK({ data: changed(0, 3) })],
    ['not a mask of 0', PAGE(), MASK({ data: changed(0, 0) })],
    ['not finite', PAGE(), MASK({ data: changed(14, 255, 255) })],
    ['are not increasing', PAGE(), MASK({ data: changed(8, ...two.subarray(16, 24)), from: 3 })],
    ['differ from the index', PAGE(), MASK({ from: 1 })],
    ['differ from the index', PAGE(), MASK({ to: 4 })],
    ['decompresses to 26', PAGE(), MASK({ codec: 1, patch: patch(20, 35) })],
    ['checksum', PAGE(), MASK({ patch: patch(24, 1) })],
  ];
  for (const [say, ...sections] of lazy) {
    const file = await SceneFile.open(layout(base, sections));
    const read = sections[1]?.kind === 'MASK' ? file.mask(1) : file.page(0);
    await assert.rejects(read, (e) => e instanceof SceneError && e.message.includes(say), say);
  }
});

test('inflating stops at the stated size', async () => {
  const base = sample().json,
    state = (data) => (e) => {
      e.writeUInt32LE(96 + 32, 20);
      e.writeUInt32LE(1, 32);
    };
  // 60 MB of zeros in 58 kB, stated as the 128 bytes of one Gaussian; then too few; then no deflate at all.
  const page = { kind: 'PAGE', codec: 1, count: 1, words: 8, from: 2, to: 7 };
  const bomb = layout(base, [{ ...page, data: Buffer.alloc(60 << 20), patch: state() }]);
  await assert.rejects(SceneFile.open(bomb), /longer compressed/);
  const big = layout(base, [{ ...page, data: Buffer.alloc(200_000), patch: state() }]);
  await assert.rejects((await SceneFile.open(big)).page(0), /decompresses to more/);
  const small = layout(base, [{ ...page, data: Buffer.alloc(100), patch: state() }]);
  await assert.rejects((await SceneFile.open(small)).page(0), /decompresses to 100/);
  const random = layout(base, [{ ...page, data: Buffer.alloc(128) }]);
  const raw = deflateRawSync(Buffer.alloc(128), { level: 9 }).length;
  const { crc32 } = await import('node:zlib');
  random.fill(0xff, random.length - raw);
  const index = random.subarray(64, 64 + random.readUInt32LE(12));
  index.writeUInt32LE(crc32(random.subarray(random.length - raw)), index.length - 64 + 24);
  random.writeUInt32LE(crc32(index), 24);
  random.writeUInt32LE(crc32(random.subarray(0, 60)), 60);
  await assert.rejects((await SceneFile.open(random)).page(0), /not valid/);
});

test('any changed byte is an error or the same image, never a hang', async () => {
  const { bytes } = sample({ scale: 0.02, masks: 0.5 }),
    next = random(3);
  for (let n = 0; n < 400; n++) {
    const broken = Buffer.from(bytes),
      where = Math.floor(next() * bytes.length);
    if (n % 4 === 3) broken.fill(255 * (n & 8), where, where + 40);
    else broken[where] ^= 1 << (n % 8);
    const cut = n % 16 === 5 ? broken.subarray(0, where) : broken;
    try {
      const file = await SceneFile.open(cut);
      for (const p of file.pages) {
        await file.page(p.id);
        if (p.mask >= 0) new KeyMask(await file.mask(p.mask)).at(3);
      }
    } catch (e) {
      assert.ok(e instanceof SceneError, `byte ${where}: ${e.stack}`);
    }
  }
});

test('sorting returns all visible Gaussians, the farthest first', async () => {
  const file = await SceneFile.open(sample().bytes),
    sorter = new Sorter(),
    known = new Map();
  let row = 0;
  for (const entry of file.pages) {
    const page = await file.page(entry.id);
    for (let i = 0; i < entry.count; i++) known.set(row * 1024 + i, [gaussian(page, entry, i), entry]);
    sorter.add({ ...page, row, from: entry.from, to: entry.to });
    row += Math.ceil(entry.count / 1024);
  }
  const out = new Uint32Array(sorter.total),
    depth = [0.1, -0.2, 0.97, 0.3];
  for (const time of [2, 3.7, 6]) {
    const { count, active } = sorter.sort({ time, depth, near: 0.01 }, out);
    assert.equal(
      active,
      file.activePages(time).reduce((n, p) => n + p.count, 0),
    );
    const seen = new Set(out.subarray(0, count));
    assert.equal(seen.size, count);
    let last = Infinity;
    const z = (g) => at(g, time).mean.reduce((s, v, k) => s + v * depth[k], depth[3]);
    for (const id of out.subarray(0, count)) {
      const here = z(known.get(id)[0]);
      assert.ok(here <= last + 1e-3, `${here} behind ${last}`);
      last = here;
    }
    for (const [id, [g, entry]] of known) {
      const visible = entry.from <= time && time < entry.to && at(g, time).opacity > 0 && z(g) > 0.011;
      if (visible) assert.ok(seen.has(id), `Gaussian ${id} at ${time}`);
    }
    assert.ok(count > 100 && count < known.size);
  }
  // Gaussians that masks hide are gone, and no others.
  const all = (time) => out.slice(0, sorter.sort({ time, depth, near: 0.01 }, out).count).sort();
  const before = all(3.7),
    { id } = file.activePages(3.7)[0],
    n = file.sections[id].count,
    seen = keyMasks(random(4), n, [3, 3.5, 4]).seen;
  const stride = Math.ceil(n / 32),
    rows = new Uint32Array(3 * stride);
  seen.forEach((row, k) => row.forEach((bit, i) => bit && (rows[k * stride + (i >> 5)] |= 1 << (i & 31))));
  sorter.mask(id, { keys: Float64Array.of(3, 3.5, 4), rows, stride });
  const own = (at) => known.get(at)[1].id === id;
  const admitted = (at) => !own(at) || seen[1][at] || seen[2][at];
  assert.ok(before.filter(own).length > before.filter((at) => own(at) && admitted(at)).length);
  assert.deepEqual(all(3.7), before.filter(admitted));
  sorter.drop(file.pages[0].id);
  assert.equal(sorter.total, known.size - file.pages[0].count);
});

// The WebGPU backend in a real headless Chromium (SwiftShader) against the f64 reference, and its stages by themselves.
// backend.test.mjs has what both backends do with a streamed file; here are pages of random words, edge codes included.

import assert from 'node:assert/strict';
import test from 'node:test';
import { at, gaussian } from './motion.js';
import { launch, open } from './browser.mjs';
import { psnr, render } from './reference.mjs';
import { PLAYER, serve } from './server.mjs';
import * as toy from './toy.mjs';

/// Least agreement of an image with the reference, dB: 8-bit rounding alone gives 59 or more.
const LEAST_DB = 50;
/// Depth shows black where alpha is below a half: a pixel whose alpha (of 255) is this close to it may fall either way.
const NEAR_HALF = 2;

const browser = await launch();
const options = { skip: !browser };
const complaints = [];
let tab, server;

test.before(async () => {
  if (!browser) return;
  const folders = { '/tests/': `${PLAYER}../tests/browser/` };
  server = await serve({ files: { 'a.html': '<!doctype html><body>' }, folders });
  const opened = await open(browser, `${server.url}a.html`);
  tab = opened.page;
  tab.on('console', (m) => m.type() === 'warning' && complaints.push(m.text()));
  complaints.push(...opened.errors);
  opened.errors.push = (text) => complaints.push(text);
  await tab.evaluate(async () => {
    Object.assign(globalThis, await import('/player/webgpu.js'), await import('/player/shaders.js'));
    globalThis.toy = await import('/tests/toy.mjs');
    globalThis.lost = [];
    // Begins a scene: pages and palettes by the arguments of toy.mjs.
    globalThis.scene = async ({ pages, palettes = [], clip = [0, 1] }, width, height) => {
      globalThis.backend ??= await WebGPUBackend.create(document.createElement('canvas'), {
        onlost: (e) => { globalThis.lost.push(e.message); } });
      backend.resize(width, height);
      backend.setScene({ clip, sh_degree: 3 });
      for (const p of palettes) backend.addPalette(toy.palette(...p));
      for (const p of pages) {
        const made = toy.page(...p);
        backend.addPage(made.page, made.entry);
      }
    };
    globalThis.picture = async (what) => {
      backend.draw({ ...what, view: toy.view(...what.view) });
      await backend.settled();
      return Array.from((await backend.readPixels()).data);
    };
  });
});

test.after(async () => {
  await browser?.close();
  await server?.close();
});

/// What the reference gets of a `scene`: Gaussians with their span and their harmonics.
function truth({ pages, palettes = [] }) {
  const known = new Map(palettes.map((p) => [p[0], toy.palette(...p)]));
  return pages.flatMap((p) => {
    const { page, entry } = toy.page(...p), colors = known.get(entry.palette);
    const value = (label) => (_, k) => [0, 1, 2].map((c) =>
      colors.ranges[Math.floor(Math.sqrt(k + 1)) - 1] * (colors.bytes[(3 * k + c) * colors.count + label] - 128) / 127);
    return Array.from({ length: page.count }, (_, i) => {
      const g = gaussian(page, entry, i);
      const sh = colors ? Array.from({ length: (colors.degree + 1) ** 2 - 1 }, value(g.label)) : [];
      return { ...g, sh, span: [entry.from, entry.to] };
    });
  });
}

const SCENE = {
  palettes: [[7, 3, 40], [8, 1, 5, 3]],
  pages: [
    [0, 1500, { from: 0, to: 1.04, palette: 7, entries: 40 }],
    [1, 700, { from: 0, to: 0.5, palette: 8, entries: 5 }],
    [2, 300, { from: 0.5, to: 1.04, logScale: [-6, -1.5] }],
  ],
};
const VIEW = [[1.5, 0.8, 2.4], 200, 150, 190];
const LOOK = { view: VIEW, background: [0.2, 0.5, 0.9], depthRange: [1.5, 4.5], flowScale: 60 };
/// Draws `what` of `setup` in the browser and by the reference; answers the agreement in dB.
async function compare(setup, what) {
  const got = await tab.evaluate(async ([s, w]) => {
    await scene(s, w.view[1], w.view[2]);
    return picture(w);
  }, [setup, what]);
  const gaussians = truth(setup), view = toy.view(...what.view);
  const want = render(gaussians, what.time, view, what);
  assert.ok(new Set(want).size > 20, 'the reference drew something');
  if (what.channel === 'depth') {
    const alpha = render(gaussians, what.time, view, { ...what, channel: 'alpha' });
    alpha.forEach((a, i) => { if (Math.abs(a - 127.5) < NEAR_HALF) want[i] = got[i]; });
  }
  return psnr(got, want);
}

const SHOWN = { color: [0.3, 0.7, 1], alpha: [0.3], depth: [0.7], flow: [0.3] };
for (const [channel, time] of Object.entries(SHOWN).flatMap(([c, times]) => times.map((t) => [c, t]))) {
  test(`${channel} at ${time} s equals the reference's`, options, async (t) => {
    const db = await compare(SCENE, { ...LOOK, channel, time });
    t.diagnostic(`${db.toFixed(1)} dB`);
    assert.ok(db >= LEAST_DB, `${db} dB`);
  });
}

test('counts are those of the last image, also where images follow faster than counts are read', options, async () => {
  const counts = await tab.evaluate(async ([s, times, what]) => {
    await scene(s, what.view[1], what.view[2]);
    const show = (time) => backend.draw({ ...what, time, channel: 'color', view: toy.view(...what.view) });
    const alone = [];
    for (const time of times) {
      show(time);
      await backend.settled();
      alone.push(backend.stats.drawn);
    }
    // The first one's reading is in progress when the second is rendered.
    for (const time of times.slice(0, 2)) show(time);
    await backend.settled();
    return { alone, last: backend.stats.drawn };
  }, [SCENE, [0.3, 0.7, 1], LOOK]);
  assert.equal(new Set(counts.alone).size, 3, JSON.stringify(counts));
  assert.equal(counts.last, counts.alone[1]);
});

test('from a camera among the Gaussians no block is culled too early', options, async (t) => {
  const setup = { pages: [[0, 5000, { from: 0, to: 1, logScale: [-5, -1.7], size: 2, edges: true, seed: 9 }]] };
  for (const eye of [[0.4, 0.1, 0.3], [-1.2, 0.3, -0.2], [2, -2, 0.1]]) {
    const db = await compare(setup, { ...LOOK, view: [eye, 120, 90, 60], time: 0.4 });
    t.diagnostic(`${db.toFixed(1)} dB`);
    assert.ok(db >= LEAST_DB, `${db} dB from ${eye}`);
  }
});

test('a clock that begins late is as accurate', options, async (t) => {
  const setup = { clip: [5000, 5001], pages: [[0, 1500, { from: 5000, to: 5001.04 }]] };
  const db = await compare(setup, { ...LOOK, time: 5000.3 });
  t.diagnostic(`${db.toFixed(1)} dB`);
  assert.ok(db >= LEAST_DB, `${db} dB`);
});

test('resident.wgsl unpacks random words and every edge code as specified', options, async (t) => {
  const [span, times] = [0.8, [-0.05, 0.31, 0.79]];
  const { page, entry } = toy.page(3, 4096, { from: 0, to: span, edges: true, opacity: [0, 255], forever: 0.1 });
  const got = await tab.evaluate(async ([span, times]) => {
    const { page } = toy.page(3, 4096, { from: 0, to: span, edges: true, opacity: [0, 255], forever: 0.1 });
    const device = await (await navigator.gpu.requestAdapter()).requestDevice();
    const code = `${RESIDENT}
      @group(0) @binding(0) var<storage, read> words: array<array<u32, 8>>;
      @group(0) @binding(1) var<storage, read> headers: array<array<f32, 24>>;
      @group(0) @binding(2) var<storage, read_write> out: array<array<f32, 18>>;
      @group(0) @binding(3) var<storage, read> time: array<f32>; // span, t
      @compute @workgroup_size(64) fn unpack(@builtin(global_invocation_id) id: vec3<u32>) {
        var f: array<vec4<f32>, 6>;
        for (var k = 0u; k < 24u; k++) { f[k / 4u][k % 4u] = headers[id.x / 256u][k]; }
        let life = life_at(words[id.x], f, time[0], time[1]);
        let g = gaussian(words[id.x], f, life);
        out[id.x] = array<f32, 18>(g.mean.x, g.mean.y, g.mean.z, g.quat.x, g.quat.y, g.quat.z, g.quat.w,
          g.scale.x, g.scale.y, g.scale.z, g.opacity, g.velocity.x, g.velocity.y, g.velocity.z,
          g.base.x, g.base.y, g.base.z, f32(g.label));
      }`;
    const module = device.createShaderModule({ code });
    const pipeline = device.createComputePipeline({ layout: 'auto', compute: { module, entryPoint: 'unpack' } });
    const storage = (size) => device.createBuffer({ size, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST
      | GPUBufferUsage.COPY_SRC });
    const bytes = 72 * page.count;
    const buffers = [page.words.byteLength, page.headers.byteLength, bytes, 8].map(storage);
    device.queue.writeBuffer(buffers[0], 0, page.words);
    device.queue.writeBuffer(buffers[1], 0, page.headers);
    const back = device.createBuffer({ size: bytes, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
    const group = device.createBindGroup({ layout: pipeline.getBindGroupLayout(0),
      entries: buffers.map((buffer, binding) => ({ binding, resource: { buffer } })) });
    const all = [];
    for (const t of times) {
      device.queue.writeBuffer(buffers[3], 0, new Float32Array([span, t]));
      const encoder = device.createCommandEncoder(), pass = encoder.beginComputePass();
      pass.setPipeline(pipeline);
      pass.setBindGroup(0, group);
      pass.dispatchWorkgroups(page.count / 64);
      pass.end();
      encoder.copyBufferToBuffer(buffers[2], 0, back, 0, bytes);
      device.queue.submit([encoder.finish()]);
      await back.mapAsync(GPUMapMode.READ);
      all.push(Array.from(new Float32Array(back.getMappedRange())));
      back.unmap();
    }
    device.destroy();
    return all;
  }, [span, times]);
  // Header numbers are f32; exp in f32 is good to a few units in the last place.
  const tolerance = 2e-5, OPACITY = 10;
  let worst = 0;
  const seen = { half: new Set(), largest: new Set() };
  times.forEach((time, k) => {
    for (let i = 0; i < page.count; i++) {
      const g = gaussian(page, entry, i), now = at(g, time);
      const want = [...now.mean, ...now.quat, ...g.scale, now.opacity, ...g.velocity, ...g.color, g.label];
      seen.half.add(page.words[8 * i + 6] >>> 24);
      seen.largest.add(page.words[8 * i + 3] >>> 30);
      want.forEach((v, c) => {
        // What cannot be seen has no opacity in motion.js.
        if (c === OPACITY && v === 0) return assert.ok(got[k][18 * i + c] < 1 / 255 + tolerance);
        const error = Math.abs(got[k][18 * i + c] - v) / Math.max(1, Math.abs(v));
        assert.ok(error <= tolerance, `Gaussian ${i}, number ${c}, ${time} s: ${got[k][18 * i + c]} is not ${v}`);
        worst = Math.max(worst, error);
      });
    }
  });
  assert.ok([0, 1, 254, 255].every((h) => seen.half.has(h)) && seen.largest.size === 4, 'every edge code was there');
  t.diagnostic(`largest relative error ${worst.toExponential(1)}`);
});

test('the order on the GPU is that of depth, then number, and repeats', options, async (t) => {
  const what = { ...LOOK, time: 0.3 };
  const [first, second] = await tab.evaluate(async ([s, w]) => {
    const run = async () => {
      await scene(s, w.view[1], w.view[2]);
      await picture(w);
      const { order, keys, records } = await backend.inspect();
      return { order: Array.from(order), keys: Array.from(keys), depths: Array.from(order, (p) => records[8 * p + 5]) };
    };
    return [await run(), await run()];
  }, [SCENE, what]);
  assert.ok(first.order.length > 1000, `${first.order.length} drawn`);
  assert.deepEqual(first.order, second.order);
  assert.equal(new Set(first.order).size, first.order.length, 'every record once');
  for (let i = 1; i < first.order.length; i++) {
    const tie = first.keys[i] === first.keys[i - 1];
    assert.ok(first.keys[i] > first.keys[i - 1] || (tie && first.order[i] > first.order[i - 1]), `place ${i}`);
  }
  // 16-bit keys: neighbours may be exchanged only where their depths are within a step of each other.
  const step = (first.depths.at(-1) - first.depths[0]) / 65535 * 4;
  first.depths.forEach((z, i) => assert.ok(i === 0 || z > first.depths[i - 1] - step, `depth ${i}`));
  t.diagnostic(`${first.order.length} records`);
});

test('pages are added and dropped, palettes arrive late, and nothing is rendered twice', options, async () => {
  const result = await tab.evaluate(async ([s, w]) => {
    await scene(s, w.view[1], w.view[2]);
    const whole = await picture(w);
    // The same in another order, with palettes last, and after a page that is dropped again.
    await scene({ ...s, pages: [], palettes: [] }, w.view[1], w.view[2]);
    const empty = await picture(w);
    const stray = toy.page(9, 900, { from: 0, to: 2, seed: 5 });
    backend.addPage(stray.page, stray.entry);
    for (const p of s.pages.toReversed()) {
      const made = toy.page(...p);
      backend.addPage(made.page, made.entry);
    }
    const other = await picture(w);
    backend.dropPage(9);
    for (const p of s.palettes) backend.addPalette(toy.palette(...p));
    const late = await picture(w);
    const resident = backend.stats.resident;
    // Switching channels and back, resizing and back, and rendering again change nothing.
    await picture({ ...w, channel: 'depth' });
    const back = await picture(w);
    backend.resize(60, 50);
    backend.resize(w.view[1], w.view[2]);
    const resized = await picture(w);
    const same = (a, b) => a.every((v, i) => v === b[i]);
    return { empty: empty.slice(0, 4), other: same(whole, other), late: same(whole, late), back: same(whole, back),
      resized: same(whole, resized), resident };
  }, [SCENE, { ...LOOK, time: 0.3 }]);
  assert.deepEqual(result, { empty: [51, 128, 230, 255], other: false, late: true, back: true, resized: true,
    resident: 2500 });
});

test('buffers grow beyond the first page and keep their content', options, async () => {
  const same = await tab.evaluate(async ([s, w]) => {
    await scene(s, w.view[1], w.view[2]);
    const before = await picture(w);
    // 65,536 Gaussians of another time: words, headers and lists must move.
    const more = toy.page(5, 65536, { from: 3, to: 4 });
    if (!backend.addPage(more.page, more.entry)) return 'no room';
    const after = await picture(w);
    return before.every((v, i) => v === after[i]);
  }, [SCENE, { ...LOOK, time: 0.3 }]);
  assert.equal(same, true);
});

test('30,000 Gaussians at 800x800: time per stage', options, async (t) => {
  const setup = { palettes: [[7, 3, 256]], pages: [[0, 30000, { from: 0, to: 1, palette: 7, entries: 256,
    logScale: [-6, -3.6] }]] };
  const what = { ...LOOK, view: [VIEW[0], 800, 800, 760] };
  const stats = await tab.evaluate(async ([s, w]) => {
    await scene(s, 800, 800);
    const view = toy.view(...w.view), walls = [];
    for (let i = 0; i < 12; i++) {
      const start = performance.now();
      backend.draw({ ...w, view, time: 0.2 + 0.02 * i });
      await backend.settled();
      walls.push(performance.now() - start);
    }
    await new Promise((done) => setTimeout(done, 50));
    return { ...backend.stats, wall: walls.sort((a, b) => a - b)[6] };
  }, [setup, what]);
  t.diagnostic(JSON.stringify(stats));
  assert.ok(stats.drawn > 5000 && stats.drawn <= 30000 && stats.active === 30000 && stats.resident === 30000);
});

test('no warnings or errors were logged', options, async () => {
  assert.deepEqual(complaints, []);
  assert.deepEqual(await tab.evaluate(() => lost), []);
});

test('a lost device is reported once, and further draws are harmless', options, async () => {
  // Chromium's own way to end the process that holds the device.
  const session = await browser.newBrowserCDPSession();
  await session.send('Browser.crashGpuProcess').catch(() => {});
  const told = await tab.evaluate(async ([s, w]) => {
    for (let i = 0; i < 100 && !lost.length; i++) await new Promise((done) => setTimeout(done, 50));
    backend.draw({ ...w, view: toy.view(...w.view), time: 0.3 });
    const made = toy.page(0, 10, { from: 0, to: 1 });
    const added = backend.addPage(made.page, made.entry);
    const failed = await backend.settled().then(() => '', (e) => e.name);
    backend.destroy();
    return { count: lost.length, text: lost[0], added, failed };
  }, [SCENE, { ...LOOK, time: 0.3 }]);
  assert.equal(told.count, 1);
  assert.match(told.text, /^The graphics device was lost/);
  assert.deepEqual([told.added, told.failed], [false, 'SceneError']);
});

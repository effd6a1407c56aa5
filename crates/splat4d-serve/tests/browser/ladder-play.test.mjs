// A bitrate ladder in a browser: a connection that becomes slower, a device that is too slow, a pinned rung against the
// CPU renderer, a simulated headset, and a large scene whose coarse tier is shown first. The file is baked by the program
// that SPLAT4D names; without it these tests are skipped.

import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { inflateRawSync } from 'node:zlib';
import { launch, open } from './browser.mjs';
import { psnr } from './reference.mjs';
import { layout, sample } from './sample.mjs';
import { PLAYER, serve } from './server.mjs';

const PROGRAM = process.env.SPLAT4D;
const IWER = path.join(process.env.PLAYWRIGHT ?? '', 'node_modules/iwer/build/iwer.min.js');
const browser = PROGRAM && existsSync(PROGRAM) ? await launch() : null;
const options = { skip: browser ? false : 'needs the program (SPLAT4D) and a browser' };
const work = mkdtempSync(path.join(tmpdir(), 'splat4d-'));
test.after(async () => {
  await browser?.close();
  rmSync(work, { recursive: true });
});

/// Times that the bundled clip is repeated, and the rates of its ladder, Mbit/s.
const ROUNDS = 12,
  RATES = [1, 2, 4];
/// A pinned rung against the CPU renderer's image of the same pages, dB.
const LIKE = 30;
const [WIDTH, HEIGHT] = [160, 120];

const run = (...args) => execFileSync(PROGRAM, args, { stdio: ['ignore', 'pipe', 'inherit'] }).toString();

let baked = null;
/// The bundled scene with a ladder: {bytes, report}.
function file() {
  if (baked) return baked;
  const knight = fileURLToPath(new URL('../../../../examples/knight.s4d', import.meta.url));
  const [out, report] = ['knight.s4d', 'report.json'].map((name) => path.join(work, name));
  run('bake', knight, '-o', out, '--repeat', `${ROUNDS}`, '--ladder', RATES.join(), '--report', report);
  return (baked = { bytes: readFileSync(out), report: JSON.parse(readFileSync(report, 'utf8')) });
}

/// The pages of a file with a lower tier, as a file of their own.
function part(bytes, tiers) {
  const index = bytes.subarray(64, 64 + bytes.readUInt32LE(12)),
    json = JSON.parse(index.subarray(4, 4 + index.readUInt32LE(0))),
    table = index.subarray(8 + index.readUInt32LE(0)),
    out = [],
    places = new Map();
  for (let i = 0; 64 * i < table.length; i++) {
    const e = table.subarray(64 * i, 64 * i + 64),
      [kind, level, codec] = [e.toString('latin1', 0, 4), e.readUInt16LE(30), e.readUInt16LE(28)],
      stored = bytes.subarray(Number(e.readBigUInt64LE(8)), Number(e.readBigUInt64LE(8)) + e.readUInt32LE(16));
    if (!['PAGE', 'PALT'].includes(kind) || (kind === 'PAGE' && level >= tiers)) continue;
    places.set(i, out.length);
    out.push({ kind, level, codec, data: codec ? inflateRawSync(stored) : stored, count: e.readUInt32LE(32), words: e.readUInt32LE(36),
      from: e.readDoubleLE(40), to: e.readDoubleLE(48), flags: e.readUInt32LE(4), palette: e.readUInt32LE(56) });
  }
  for (const s of out) if (places.has(s.palette)) s.palette = places.get(s.palette);
  delete json.ladder;
  json.gaussians = out.reduce((n, s) => n + (s.kind === 'PAGE' ? s.count : 0), 0);
  return layout(json, out);
}

const element = (attributes, backend) => `<!doctype html><link rel="icon" href="data:,"><style>body{margin:0}</style><splat-4d
  src="/scene.s4d" backend="${backend}" resolution="1" ${attributes} style="display:block;width:${WIDTH}px;height:${HEIGHT}px;min-height:0">
  </splat-4d><script type="module" src="/player/element.js"></script>`;
const LOADED = () => document.querySelector('splat-4d').statistics?.firstFrame > 0;

/// Records, in the page, what the element reports: rungs, and when its clock waits.
const RECORD = () =>
  addEventListener('DOMContentLoaded', () => {
    const e = document.querySelector('splat-4d');
    globalThis.rungs = [];
    globalThis.stalls = 0;
    e.addEventListener('rungchange', ({ detail }) => globalThis.rungs.push({ ...detail, at: performance.now() }));
    const wait = () => {
      const { player } = e;
      if (!player) return setTimeout(wait, 5);
      player.addEventListener('waiting', ({ detail }) => (globalThis.stalls += detail.waiting && player.state === 'ready' ? 1 : 0));
    };
    wait();
  });

async function opened(t, attributes, { bytes = file().bytes, rate = 0, init = [], backend = 'webgl2' } = {}) {
  const server = await serve({ files: { 'page.html': element(attributes, backend), 'empty.html': '<!doctype html>', 'scene.s4d': bytes }, rate });
  const { page, errors } = await open(browser, `${server.url}empty.html`);
  t.after(() => Promise.all([page.close(), server.close()]));
  for (const script of [RECORD, ...init]) await page.addInitScript(script);
  await page.goto(`${server.url}page.html`);
  await page.waitForFunction(LOADED, null, { timeout: 60_000 });
  return { page, errors, server };
}

/// Frames that SwiftShader renders are no measure of a device.
const FAST = () =>
  addEventListener('DOMContentLoaded', () => {
    const wait = () => {
      const { player } = document.querySelector('splat-4d');
      if (player) player.frameTook = () => {};
      else setTimeout(wait, 5);
    };
    wait();
  });

test('every rung is within its rate, and images become better from rung to rung', options, (t) => {
  const { ladder } = file().report;
  t.diagnostic(ladder.map((r) => `${r.rate.toFixed(2)} Mbit/s: ${r.gaussians} Gaussians, ${r.psnr?.toFixed(2) ?? 'whole'} dB`).join('; '));
  assert.deepEqual(ladder.slice(0, 3).map((r) => r.rate), RATES);
  assert.ok(ladder.every((r) => r.most <= r.rate + 1e-6));
  assert.ok(ladder[0].psnr < ladder[1].psnr && ladder[1].psnr < ladder[2].psnr);
});

test('at 10 Mbit/s the first image comes early and nothing stalls; at 2.5 a lower rung plays on', options, async (t) => {
  const { page, errors, server } = await opened(t, 'autoplay', { rate: 10e6, init: [FAST] });
  const first = await page.evaluate(() => {
    const { firstFrame, bytesRead } = document.querySelector('splat-4d').statistics;
    return { firstFrame, bytesRead };
  });
  await page.waitForTimeout(6000);
  const before = await page.evaluate(() => ({ stalls: globalThis.stalls, ...document.querySelector('splat-4d').ladder, megabits: document.querySelector('splat-4d').statistics.megabits }));
  server.options.rate = 2.5e6;
  const changed = await page.evaluate(() => performance.now());
  const lower = () => document.querySelector('splat-4d').ladder.chosen <= 2;
  await page.waitForFunction(lower, null, { timeout: 20_000 }).catch(() => {});
  await page.waitForTimeout(4000);
  const after = await page.evaluate(() => ({
    stalls: globalThis.stalls,
    rungs: globalThis.rungs,
    ...document.querySelector('splat-4d').statistics,
  }));
  const down = after.rungs.find((r) => r.at > changed && r.chosen <= 2);
  t.diagnostic(`first image after ${first.firstFrame.toFixed(0)} ms, ${first.bytesRead} bytes; rung ${before.chosen} at 10 Mbit/s (${before.megabits.toFixed(1)} measured), stalls ${before.stalls}; \
rung ${after.ladder.chosen} ${((down?.at ?? NaN) - changed).toFixed(0)} ms after 2.5 Mbit/s (${after.megabits.toFixed(1)} measured), stalls ${after.stalls}`);
  const { ladder } = file().report;
  // A second of the line; how much later this machine renders it is no property of the file.
  assert.ok(ladder[0].first_image_bytes < 10e6 / 8, JSON.stringify(ladder[0]));
  // A busy machine is a slower line.
  const kept = (state, megabits) => ladder[state.chosen - 1].rate <= megabits || state.chosen === 1;
  assert.ok(kept(before, before.megabits) && before.stalls <= 1, JSON.stringify(before));
  if (before.megabits > 8) assert.ok(before.chosen >= 3 && before.stalls === 0, JSON.stringify(before));
  assert.ok(kept(after.ladder, 2.5) && after.ladder.chosen <= before.chosen && after.stalls <= 2, JSON.stringify(after.ladder));
  assert.deepEqual(errors, []);
});

test('a pinned rung is the CPU render of its pages, and idle pages become whole', options, async (t) => {
  const { bytes, report } = file(),
    { page, errors } = await opened(t, 'rung="2" time="0.5"', { init: [FAST] });
  const grab = () =>
    page.evaluate(async () => {
      const e = document.querySelector('splat-4d'),
        { player } = e;
      await e.settled();
      const { width, height } = player.canvas,
        { view } = player.drawing(width, height);
      const data = await createImageBitmap(await e.screenshot()).then((image) => {
        const draw = new OffscreenCanvas(image.width, image.height).getContext('2d');
        draw.drawImage(image, 0, 0);
        return [...draw.getImageData(0, 0, image.width, image.height).data];
      });
      const fov = (2 * Math.atan(view.height / 2 / view.fy) * 180) / Math.PI;
      return { data, width, height, pose: [...view.cameraFromWorld], fov, time: e.currentTime, ladder: e.ladder };
    });
  const pinned = await grab();
  assert.deepEqual([pinned.ladder.rung, pinned.ladder.chosen, pinned.ladder.reason], [2, 2, 'pinned']);
  assert.ok(pinned.ladder.leftOut > 0);
  const scene = path.join(work, 'part.s4d'),
    route = path.join(work, 'route.json'),
    folder = path.join(work, 'images');
  writeFileSync(scene, part(bytes, report.ladder[1].tiers));
  const { pose: m, fov, time } = pinned;
  const key = (at) => ({ time: at, scene_time: time, fov_y: fov, world_to_camera: [0, 4, 8].map((r) => m.slice(r, r + 4)).concat([[0, 0, 0, 1]]) });
  writeFileSync(route, JSON.stringify({ fps: 1, keys: [key(0), key(1)] }));
  run('render', scene, '--device', 'cpu', '--path', route, '--size', `${pinned.width}x${pinned.height}`, '-o', `${folder}/`);
  const png = readFileSync(path.join(folder, '00000.png')).toString('base64');
  const want = await page.evaluate(async (png) => {
    const image = await createImageBitmap(await (await fetch(`data:image/png;base64,${png}`)).blob(), { colorSpaceConversion: 'none' });
    const draw = new OffscreenCanvas(image.width, image.height).getContext('2d');
    draw.drawImage(image, 0, 0);
    return [...draw.getImageData(0, 0, image.width, image.height).data];
  }, png);
  const like = psnr(Buffer.from(pinned.data), Buffer.from(want));
  t.diagnostic(`rung 2 against the CPU: ${like.toFixed(1)} dB`);
  assert.ok(like > LIKE, `${like} dB`);
  await page.evaluate(() => document.querySelector('splat-4d').setAttribute('rung', 'auto'));
  const whole = await grab();
  assert.deepEqual([whole.ladder.rung, whole.ladder.leftOut], [whole.ladder.rungs, 0]);
  const changed = psnr(Buffer.from(pinned.data), Buffer.from(whole.data));
  assert.ok(changed < 45, `the whole file shows more: ${changed} dB`);
  assert.deepEqual(errors, []);
});

for (const backend of ['webgl2', 'webgpu']) test(`a device that is too slow renders a lower rung with ${backend}, and the player reports it`, options, async (t) => {
  const { page, errors } = await opened(t, 'loop="false"', { backend });
  const seen = await page.evaluate(async () => {
    const e = document.querySelector('splat-4d');
    await e.settled();
    const before = { ...e.ladder, drawn: e.statistics.drawn };
    // Frames as a slow device would take them.
    const start = performance.now();
    for (let i = 0; i < 16; i++) e.player.frameTook(120, start + 120 * i, { stuck: true });
    await new Promise((done) => setTimeout(done, 600));
    await e.settled();
    return { before, after: { ...e.ladder, drawn: e.statistics.drawn }, rungs: globalThis.rungs,
      text: e.shadowRoot.querySelector('.toast').textContent };
  });
  t.diagnostic(`${seen.before.drawn} Gaussians rendered, then ${seen.after.drawn}; "${seen.text}"`);
  assert.equal(seen.before.rung, seen.before.rungs);
  assert.deepEqual([seen.after.limit, seen.after.reason], [seen.before.rungs - 1, 'device']);
  assert.equal(seen.after.rung, seen.before.rungs - 1);
  assert.ok(seen.after.leftOut > 0 && seen.after.drawn < seen.before.drawn, JSON.stringify(seen));
  assert.ok(seen.rungs.some((r) => r.reason === 'device') && /Slow device: bit rate 3 of 4/.test(seen.text), seen.text);
  assert.deepEqual(errors, []);
});

test('the object of three.js renders the rung that is set', options, async (t) => {
  const map = { imports: { 'splat4d/three': '/npm/three.js', three: '/three/three.module.js' } };
  const html = `<!doctype html><link rel="icon" href="data:,"><script type="importmap">${JSON.stringify(map)}</script><canvas width="160" height="120">
    </canvas><script type="module">import * as THREE from 'three'; import { Splat4D } from 'splat4d/three'; Object.assign(globalThis, { THREE, Splat4D });
    globalThis.there = true;</script>`;
  const npm = fileURLToPath(new URL('../../npm/', import.meta.url)),
    three = path.join(process.env.PLAYWRIGHT ?? '', 'node_modules/three/build/');
  const server = await serve({ files: { 'page.html': html, 'scene.s4d': file().bytes }, folders: { '/npm/player/': PLAYER, '/npm/': npm, '/three/': three } });
  const { page, errors } = await open(browser, `${server.url}page.html`);
  t.after(() => Promise.all([page.close(), server.close()]));
  await page.waitForFunction(() => globalThis.there, null, { timeout: 30_000 });
  const seen = await page.evaluate(async () => {
    const { THREE, Splat4D } = globalThis,
      renderer = new THREE.WebGLRenderer({ canvas: document.querySelector('canvas') }),
      scene = new THREE.Scene(),
      object = new Splat4D('/scene.s4d', { rung: 1 });
    scene.add(object);
    await object.ready;
    const camera = new THREE.PerspectiveCamera(50, 4 / 3, 0.05, 100);
    camera.position.set(0, 1, 6);
    const rendered = async () => {
      for (let i = 0; i < 2; i++) {
        renderer.render(scene, camera);
        await object.settled();
      }
      renderer.render(scene, camera);
      return { drawn: object.drawn, rung: object.rung, ...object.ladder };
    };
    const low = await rendered();
    object.rung = 'auto';
    return [low, await rendered()];
  });
  const [low, whole] = seen;
  t.diagnostic(`${low.drawn} Gaussians in rung 1, ${whole.drawn} in all`);
  assert.deepEqual([low.rung, low.chosen, low.reason], [1, 1, 'pinned']);
  assert.ok(low.leftOut > 0 && low.drawn > 0 && low.drawn < whole.drawn && whole.leftOut === 0, JSON.stringify(seen));
  assert.deepEqual(errors, []);
});

test('a simulated headset plays a ladder', { skip: browser && existsSync(IWER) ? false : 'needs iwer and a browser' }, async (t) => {
  const device = () => {
    window.device = new IWER.XRDevice(IWER.metaQuest3);
    window.device.installRuntime({ forceInstall: true });
    window.device.stereoEnabled = true;
  };
  const { page, errors } = await opened(t, 'autoplay', { init: [{ path: IWER }, device, FAST] });
  const seen = await page.evaluate(async () => {
    const { player } = document.querySelector('splat-4d'),
      xr = await import('/player/xr.js'),
      ended = xr.enter(player);
    const wait = async (until) => {
      for (let i = 0; i < 400 && !until(); i++) await new Promise((done) => setTimeout(done, 50));
      if (!until()) throw new Error('nothing came');
    };
    await wait(() => window.device.activeSession?.renderState.baseLayer);
    const from = player.time;
    await wait(() => player.time !== from && player.rungState.rung > 0);
    const state = { ...player.rungState, drawn: player.statistics.drawn };
    await window.device.activeSession.end();
    await ended;
    return state;
  });
  t.diagnostic(`in the headset: rung ${seen.rung} of ${seen.rungs} (${seen.reason}), ${seen.drawn} Gaussians`);
  assert.ok(seen.drawn > 0);
  assert.deepEqual(errors, []);
});

test('of a large scene the coarse tier is shown first, then the rest', options, async (t) => {
  // Tiers of 42,000 and 61,500 Gaussians at one time, about 1.3 and 2 MB.
  const { bytes } = sample({ scale: 60, json: { ladder: undefined } });
  const { page, errors } = await opened(t, '', { bytes, rate: 4e6 });
  const first = await page.evaluate(() => ({ ready: document.querySelector('splat-4d').player.ready(2), ...document.querySelector('splat-4d').statistics }));
  assert.ok(first.ready > 0.2 && first.ready < 1, `${first.ready}`);
  await page.waitForFunction(() => document.querySelector('splat-4d').player.ready(2) === 1, null, { timeout: 60_000 });
  t.diagnostic(`coarse image after ${first.firstFrame.toFixed(0)} ms with ${(100 * first.ready).toFixed(0)} % of the Gaussians`);
  assert.equal(first.ladder, null);
  assert.deepEqual(errors, []);
});

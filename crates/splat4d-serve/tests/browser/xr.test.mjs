// A headset's session against a simulated device (npm's iwer, next to playwright-core): it begins, draws both eyes
// as they are
// turned, and gives the player back.

import assert from 'node:assert/strict';
import { existsSync, readFileSync } from 'node:fs';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { launch } from './browser.mjs';
import { serve } from './server.mjs';

const IWER = path.join(process.env.PLAYWRIGHT ?? '', 'node_modules/iwer/build/iwer.min.js');
const KNIGHT = readFileSync(fileURLToPath(new URL('../../../../examples/knight.s4d', import.meta.url)));
const browser = existsSync(IWER) ? await launch() : null;
test.after(() => browser?.close());

const PAGE = `<!doctype html><link rel="icon" href="data:,"><style>body{margin:0}splat-4d{display:block;width:320px;height:160px}</style>
  <splat-4d src="/knight.s4d" backend="webgl2" resolution="1"></splat-4d><script type="module" src="/player/element.js"></script>`;

const options = { skip: browser ? false : 'needs iwer and a browser' };

/// A page with the knight and a simulated headset: {page, errors}.
async function prepared(t) {
  const server = await serve({ files: { 'page.html': PAGE, 'knight.s4d': KNIGHT } });
  const page = await browser.newPage({ viewport: { width: 320, height: 160 } });
  t.after(() => Promise.all([page.close(), server.close()]));
  const errors = [];
  page.on('pageerror', (e) => errors.push(e.stack ?? e.message));
  await page.addInitScript({ path: IWER });
  await page.addInitScript(() => {
    window.device = new IWER.XRDevice(IWER.metaQuest3);
    window.device.installRuntime({ forceInstall: true });
    window.device.stereoEnabled = true;
  });
  await page.goto(server.url + 'page.html');
  await page.waitForFunction(() => document.querySelector('splat-4d').statistics?.firstFrame > 0, null, { timeout: 60000 });
  return { page, errors };
}

test('a simulated headset sees the scene with both eyes', options, async (t) => {
  const { page, errors } = await prepared(t);
  const seen = await page.evaluate(async () => {
    const element = document.querySelector('splat-4d'),
      { player } = element;
    const xr = await import('/player/xr.js');
    let over = false;
    let failed = null;
    const ended = xr.enter(player).then(
      () => (over = true),
      (error) => (failed = error),
    );
    const wait = async (until) => {
      for (let i = 0; i < 600 && !failed && !until(); i++) await new Promise((done) => setTimeout(done, 50));
      if (failed || !until()) throw failed ?? new Error('nothing came');
    };
    await wait(() => window.device.activeSession?.renderState.baseLayer);
    const session = window.device.activeSession;
    /// The image that the session's next frame but one left: bytes of its left and of its right half.
    const halves = () =>
      new Promise((done) => {
        session.requestAnimationFrame(() =>
          session.requestAnimationFrame(() => {
            const { gl } = player.backend,
              { framebufferWidth: w, framebufferHeight: h } = session.renderState.baseLayer;
            gl.bindFramebuffer(gl.FRAMEBUFFER, session.renderState.baseLayer.framebuffer);
            const read = (x) => {
              const bytes = new Uint8Array(4 * (w >> 1) * h);
              gl.readPixels(x, 0, w >> 1, h, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
              return bytes;
            };
            done([read(0), read(w >> 1)]);
          }),
        );
      });
    const mean = (bytes) => bytes.reduce((sum, b) => sum + b, 0) / bytes.length;
    const apart = (a, b) => a.reduce((sum, x, i) => sum + Math.abs(x - b[i]), 0) / a.length;
    const spread = (bytes) => apart(bytes, new Uint8Array(bytes.length).fill(mean(bytes)));
    await wait(() => player.backend.stats.drawn > 1000);
    const [left, right] = await halves();
    // A quarter of a turn to the left.
    window.device.quaternion.set(0, Math.SQRT1_2, 0, Math.SQRT1_2);
    await new Promise((done) => setTimeout(done, 500));
    const [turned] = await halves();
    const figures = { left: spread(left), right: spread(right), eyes: apart(left, right), turned: apart(left, turned) };
    await session.end();
    await ended;
    await element.settled();
    return { ...figures, over, width: player.canvas.width };
  });
  t.diagnostic(JSON.stringify(seen));
  assert.ok(seen.left > 5 && seen.right > 5, 'both eyes see something');
  assert.ok(seen.eyes > 0.5, 'from two places');
  assert.ok(seen.turned > seen.eyes, 'and turning the head turns the view');
  assert.ok(seen.over && seen.width === 320, 'the page has its player back');
  assert.deepEqual(errors, []);
});

test('in a simulated room the scene is on the floor, and a tap moves it', options, async (t) => {
  const { page, errors } = await prepared(t);
  const seen = await page.evaluate(async () => {
    const { player, shadowRoot } = document.querySelector('splat-4d');
    const xr = await import('/player/xr.js');
    let failed = null;
    const ended = xr.enter(player, 'immersive-ar').catch((error) => (failed = error));
    const wait = async (until) => {
      for (let i = 0; i < 600 && !failed && !until(); i++) await new Promise((done) => setTimeout(done, 50));
      if (failed || !until()) throw failed ?? new Error('nothing came');
    };
    window.device.stereoEnabled = false;
    window.device.position.set(0, 1.6, 0);
    await wait(() => window.device.activeSession?.renderState.baseLayer);
    const session = window.device.activeSession;
    await wait(() => player.backend.stats.drawn > 1000);
    /// Share of pixels that are drawn, and their middle across, 0 to 1, once two images are alike.
    const look = () =>
      new Promise((done) => {
        let left = 8;
        const tick = () => {
          if (left-- > 0) return session.requestAnimationFrame(tick);
          const { gl } = player.backend,
            { framebufferWidth: w, framebufferHeight: h, framebuffer } = session.renderState.baseLayer;
          gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
          const bytes = new Uint8Array(4 * w * h);
          gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
          let [count, across, down] = [0, 0, 0];
          for (let i = 0; i < w * h; i++) {
            if (bytes[4 * i] + bytes[4 * i + 1] + bytes[4 * i + 2] < 60) continue;
            count++;
            across += (i % w) / w;
            down += 1 - Math.floor(i / w) / h;
          }
          done({ share: count / (w * h), across: across / count, down: down / count });
        };
        session.requestAnimationFrame(tick);
      });
    const first = await look();
    // Down to the right: a ray from the hand that meets the floor at x = 1.2, 2 m ahead.
    const hand = window.device.controllers.right;
    hand.connected = true;
    hand.position.set(0.2, 1.2, -0.2);
    const from = [0.2, 1.2, -0.2],
      way = [1.2 - from[0], -from[1], -2 - from[2]],
      length = Math.hypot(...way),
      [x, y, z] = way.map((v) => v / length);
    // The shortest turn that takes -z there.
    const w = 1 - z,
      norm = Math.hypot(y, x, w);
    hand.quaternion.set(y / norm, -x / norm, 0, w / norm);
    await look();
    hand.updateButtonValue('trigger', 1);
    await look();
    hand.updateButtonValue('trigger', 0);
    const second = await look();
    const buttons = [...shadowRoot.querySelectorAll('button')].filter((b) => /AR/.test(b.title + b.ariaLabel) && !b.hidden).length;
    await session.end();
    await ended;
    return { first, second, buttons };
  });
  t.diagnostic(JSON.stringify(seen));
  assert.ok(seen.first.share > 0.01 && seen.first.share < 0.6, 'it stands in the room and does not fill it');
  assert.ok(Math.abs(seen.first.across - 0.5) < 0.08 && seen.first.down > 0.5, 'ahead, below the eyes');
  assert.ok(seen.second.share > 0.003 && seen.second.across > seen.first.across + 0.1, 'the tap moved it to the right');
  assert.equal(seen.buttons, 1);
  assert.deepEqual(errors, []);
});

test('canted eyes are rendered in their own orders, and edges are left out around a whole middle', options, async (t) => {
  const { page, errors } = await prepared(t);
  const seen = await page.evaluate(async () => {
    const element = document.querySelector('splat-4d'),
      { player } = element,
      { backend } = player;
    await element.settled();
    const { eyeView } = await import('/player/xr.js');
    // The page renders nothing of its own meanwhile.
    player.immersed = true;
    const size = 96,
      projectionMatrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, -1, 0, 0, -0.02, 0],
      start = player.camera.clone();
    /// An eye that is turned outwards by half of `degrees`.
    const eye = (right, degrees) => {
      const half = ((right ? -1 : 1) * degrees * Math.PI) / 720,
        orientation = { w: Math.cos(half), x: 0, y: Math.sin(half), z: 0 };
      return eyeView({ transform: { position: { x: right ? 0.03 : -0.03, y: 0, z: 0 }, orientation }, projectionMatrix }, start, 0.1, size, size);
    };
    backend.resize(size, size);
    const render = async (view, more) => {
      const what = { ...player.drawing(size, size), view, force: true, ...more };
      backend.draw(what);
      await backend.settled();
      backend.draw(what);
      return { data: (await backend.readPixels()).data, ...backend.stats };
    };
    /// Pixels that differ; `middle`: of the middle third only.
    const differ = (a, b, middle = false) => {
      let n = 0;
      for (let i = 0; i < size * size; i++) {
        const inside = [i % size, Math.floor(i / size)].every((x) => Math.abs(x + 0.5 - size / 2) < size / 6);
        if (!middle || inside) n += [0, 1, 2].some((c) => a.data[4 * i + c] !== b.data[4 * i + c]) ? 1 : 0;
      }
      return n;
    };
    const eyes = [eye(false, 20), eye(true, 20)],
      own = [await render(eyes[0]), await render(eyes[1])],
      both = [await render(eyes[0], { eyes, eye: 0 }), await render(eyes[1], { eyes, eye: 1 })],
      shared = await render(eyes[1], { eyes: [eyes[0]], eye: 1 }),
      parallel = [eye(false, 0), eye(true, 0)],
      alone = await render(parallel[1]),
      one = await render(parallel[1], { eyes: parallel, eye: 1 }),
      thin = await render(parallel[1], { eyes: parallel, eye: 1, fovea: { inner: Math.SQRT2 / 3, tier: 1 } });
    return {
      canted: [differ(own[0], both[0]), differ(own[1], both[1])],
      shared: differ(own[1], shared),
      parallel: differ(alone, one),
      edges: differ(one, thin),
      middle: differ(one, thin, true),
      drawn: [one.drawn, thin.drawn],
      foveated: [one.foveated, thin.foveated],
    };
  });
  t.diagnostic(JSON.stringify(seen));
  assert.deepEqual(seen.canted, [0, 0], 'each eye as if it were alone');
  assert.ok(seen.shared > 0, 'the order of the other eye renders something else');
  assert.equal(seen.parallel, 0, 'one order is exact for parallel eyes');
  assert.equal(seen.foveated[0], 0);
  assert.ok(seen.foveated[1] > 0 && seen.drawn[1] === seen.drawn[0] - seen.foveated[1]);
  assert.ok(seen.edges > 0 && seen.middle <= seen.edges / 50, 'the middle third is whole');
  assert.deepEqual(errors, []);
});

test('a headset whose frames are late thins the edges, and reports it', options, async (t) => {
  const { page, errors } = await prepared(t);
  const seen = await page.evaluate(async () => {
    const { player } = document.querySelector('splat-4d');
    const { enter } = await import('/player/xr.js');
    // The session's own times are ten times as long: no machine renders frames of 2 ms.
    const request = XRSession.prototype.requestAnimationFrame;
    XRSession.prototype.requestAnimationFrame = function (callback) {
      return request.call(this, (now, frame) => callback(10 * now, frame));
    };
    // A layer that offers fixed foveation.
    const strengths = [];
    Object.defineProperty(XRWebGLLayer.prototype, 'fixedFoveation', { get: () => strengths.at(-1) ?? 0, set: (x) => strengths.push(x) });
    const ended = enter(player);
    const whole = player.statistics.foveated;
    for (let i = 0; i < 600 && !player.statistics.foveated; i++) await new Promise((done) => setTimeout(done, 50));
    const { foveated, drawn } = player.statistics;
    await window.device.activeSession.end();
    await ended;
    return { whole, foveated, drawn, first: strengths[0], last: strengths.at(-1) };
  });
  t.diagnostic(JSON.stringify(seen));
  assert.ok(seen.whole === 0 && seen.foveated > 0 && seen.drawn > 0);
  assert.deepEqual([seen.first, seen.last], [0, 1]);
  assert.deepEqual(errors, []);
});

test('a page measures its device, then the headset', options, async (t) => {
  const { page, errors } = await prepared(t);
  const seen = await page.evaluate(async () => {
    const element = document.querySelector('splat-4d'),
      { player } = element,
      { measure } = await import('/player/measure.js'),
      { enter } = await import('/player/xr.js'),
      rows = [];
    await measure(element, (row) => rows.push(row), { before: 1, seconds: 3 });
    const ended = enter(player);
    for (let i = 0; i < 600 && rows.length < 2; i++) await new Promise((done) => setTimeout(done, 50));
    await window.device.activeSession.end();
    await ended;
    return { rows, frames: player.figures.frames };
  });
  t.diagnostic(JSON.stringify(seen));
  const cells = seen.rows.map((row) => row.split('|').slice(1, -1).map((cell) => cell.trim()));
  assert.equal(cells.length, 2);
  for (const [, , rung, drawn, fps] of cells) assert.ok(rung === 'whole' && +drawn.replace(',', '') > 1000 && +fps > 0 && +fps < 1000);
  assert.match(cells[0][0], /^320×\d+, .*SwiftShader/);
  assert.match(cells[1][0], /^headset, /);
  assert.ok(seen.frames > 0);
  assert.deepEqual(errors, []);
});

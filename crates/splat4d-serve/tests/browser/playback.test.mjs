// What is seen while the clock runs, against the CPU renderer at the time that the page reports: an order or an alive
// set of another time shows as ghosts and holes. SPLAT4D names the program; without it these tests are skipped.
// SwiftShader is the slow device on which such a delay shows.
// FRAMES names a folder that keeps the images.

import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { existsSync, mkdirSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { launch, open } from './browser.mjs';
import { psnr } from './reference.mjs';
import { PLAYER, serve } from './server.mjs';

/// Every frame against the CPU renderer, dB.
const BOUND = 30;
const FRAMES = 30;
const [WIDTH, HEIGHT] = [160, 120];
/// Scene seconds against the wall's while it plays: frames may be few, but the clock is not late by more than a busy
/// machine makes it.
const REAL_TIME = 0.3;

const file = (name) => fileURLToPath(new URL(`../../../../${name}`, import.meta.url));
const KNIGHT = readFileSync(file('examples/knight.s4d'));
const NPM = file('crates/splat4d-serve/npm/');
const THREE = path.join(process.env.PLAYWRIGHT ?? '', 'node_modules/three/build');
const PROGRAM = process.env.SPLAT4D;
const browser = PROGRAM && existsSync(PROGRAM) ? await launch() : null;
const options = { skip: browser ? false : 'needs the program (SPLAT4D) and a browser' };
const work = mkdtempSync(path.join(tmpdir(), 'splat4d-'));
test.after(async () => {
  await browser?.close();
  rmSync(work, { recursive: true });
});

const MAP = { imports: { 'splat4d/three': '/npm/three.js', three: '/three/three.module.js' } };

/// A page of this body with the player, the three.js object and the bundled scene.
async function page(body, t) {
  const html = `<!doctype html><link rel="icon" href="data:,"><style>body{margin:0}</style>
    <script type="importmap">${JSON.stringify(MAP)}</script>${body}`;
  const folders = { '/npm/player/': PLAYER, '/npm/': NPM, '/three/': `${THREE}/` };
  const server = await serve({ files: { 'page.html': html, 'knight.s4d': KNIGHT }, folders });
  const opened = await open(browser, `${server.url}page.html`, { viewport: { width: 640, height: 480 } });
  t.after(() => Promise.all([opened.page.close(), server.close()]));
  return opened;
}

const element = (attributes) => `<splat-4d src="/knight.s4d" controls="none" ${attributes}
  style="display:block;width:${WIDTH}px;height:${HEIGHT}px;min-height:0"></splat-4d><script type="module" src="/player/element.js"></script>`;
const ready = (p) =>
  p.waitForFunction(() => document.querySelector('splat-4d').statistics?.firstFrame > 0, null, { timeout: 60000 });

/// In the page: copies `canvas` in the task that rendered it, as base64, and the 3x4 pose of its camera with its field
/// of view.
const HELP = () => {
  globalThis.copyOf = (canvas) => {
    const { width, height } = canvas,
      draw = new OffscreenCanvas(width, height).getContext('2d');
    draw.drawImage(canvas, 0, 0);
    const { data } = draw.getImageData(0, 0, width, height);
    return btoa(Array.from(data, (b) => String.fromCharCode(b)).join(''));
  };
};

/// Plays and grabs `frames` images of the element, each as {time, pose, fov, rgba, wall}.
const grab = (p, frames, before = () => {}) =>
  p.evaluate(
    async ([frames, before]) => {
      const e = document.querySelector('splat-4d'),
        { player } = e,
        out = [];
      new Function('e', before)(e);
      await new Promise((done) => {
        const see = ({ detail }) => {
          if (out.length >= frames) return done();
          const { view } = player.drawing(player.canvas.width, player.canvas.height),
            fov = (2 * Math.atan(view.height / 2 / view.fy) * 180) / Math.PI;
          // A scene that has just come may show its coarsest tier first.
          if (player.ready(detail.time) < 1) return;
          out.push({ time: detail.time, said: e.currentTime, pose: [...view.cameraFromWorld], fov, wall: performance.now(),
            rgba: globalThis.copyOf(player.canvas) });
        };
        e.addEventListener('timeupdate', see);
      });
      return out;
    },
    [frames, `(${before})(e)`],
  );

/// RGBA of what the CPU renderer makes of the frames' times and poses, by one command.
async function references(p, name, frames) {
  const keys = frames.map(({ time, pose: m, fov }, i) => ({
    time: i, scene_time: time, fov_y: fov, world_to_camera: [0, 4, 8].map((r) => m.slice(r, r + 4)).concat([[0, 0, 0, 1]]),
  }));
  keys.push({ ...keys.at(-1), time: keys.length });
  const [route, folder, scene] = ['json', '', 'splat4d'].map((end) => path.join(work, end ? `${name}.${end}` : name));
  writeFileSync(route, JSON.stringify({ fps: 1, keys }));
  writeFileSync(scene, KNIGHT);
  const size = `${WIDTH}x${HEIGHT}`;
  const args = ['render', scene, '--device', 'cpu', '--path', route, '--size', size, '-o', `${folder}/`];
  execFileSync(PROGRAM, args, { stdio: ['ignore', 'ignore', 'inherit'] });
  const pngs = frames.map((_, i) => readFileSync(path.join(folder, `${String(i).padStart(5, '0')}.png`)).toString('base64'));
  return p.evaluate(async (pngs) => {
    const out = [];
    for (const png of pngs) {
      const blob = await (await fetch(`data:image/png;base64,${png}`)).blob();
      out.push(globalThis.copyOf(await createImageBitmap(blob, { colorSpaceConversion: 'none' })));
    }
    return out;
  }, pngs);
}

/// Compares frames with the CPU renderer; every one must agree.
async function compare(p, t, name, frames) {
  const want = await references(p, name, frames);
  const bytes = (base64) => Buffer.from(base64, 'base64');
  const db = frames.map((f, i) => psnr(bytes(f.rgba), bytes(want[i])));
  const sorted = db.toSorted((a, b) => a - b);
  t.diagnostic(`${name}: ${sorted[0].toFixed(1)} to ${sorted.at(-1).toFixed(1)} dB, median ${sorted[frames.length >> 1].toFixed(1)}`);
  if (process.env.FRAMES) {
    mkdirSync(process.env.FRAMES, { recursive: true });
    for (const [i, f] of frames.entries()) {
      const pairs = await p.evaluate(async ([a, b, w, h]) => {
        const canvas = new OffscreenCanvas(2 * w, h);
        [a, b].forEach((text, k) => {
          const data = Uint8ClampedArray.from(atob(text), (c) => c.charCodeAt(0));
          canvas.getContext('2d').putImageData(new ImageData(data, w, h), k * w, 0);
        });
        const blob = await canvas.convertToBlob();
        return btoa(Array.from(new Uint8Array(await blob.arrayBuffer()), (b) => String.fromCharCode(b)).join(''));
      }, [f.rgba, want[i], WIDTH, HEIGHT]);
      writeFileSync(path.join(process.env.FRAMES, `${name}-${i}-${f.time.toFixed(3)}s-${db[i].toFixed(0)}dB.png`), bytes(pairs));
    }
  }
  db.forEach((x, i) => assert.ok(x >= BOUND, `${name}, frame ${i} at ${frames[i].time} s: ${x.toFixed(1)} dB`));
}

/// Scene seconds that went by over the frames, of a loop of `length` s, against `speed` times the wall's.
function pace(frames, length, speed) {
  let scene = 0;
  const wall = (frames.at(-1).wall - frames[0].wall) / 1000;
  for (let i = 1; i < frames.length; i++) {
    const [a, b] = [frames[i - 1], frames[i]];
    // Whole rounds that went by between two frames of a slow device cannot be seen.
    const step = b.time - a.time,
      about = ((b.wall - a.wall) / 1000) * speed;
    scene += step + length * Math.round((about - step) / length);
  }
  return scene / wall / speed;
}

for (const backend of ['webgl2', 'webgpu']) {
  test(`${backend}: every frame of a playback exists in the file`, options, async (t) => {
    const { page: p, errors } = await page(element(`backend="${backend}" resolution="1"`), t);
    await ready(p);
    await p.evaluate(HELP);
    const length = await p.evaluate(() => ((e) => e.duration + e.player.frameTime)(document.querySelector('splat-4d')));
    const once = await grab(p, FRAMES, (e) => e.play());
    const fast = await grab(p, FRAMES, (e) => (e.player.speed = 4));
    // From another side, and back, while it plays.
    const jumps = await grab(p, 6, (e) => {
      let n = 0;
      e.player.speed = 1;
      e.player.view(7);
      e.addEventListener('timeupdate', () => n++ < 6 && n % 2 && e.seek([0.9, 0.1, 0.5][n >> 1]));
    });
    // Another version of the scene, as live training and the editor put it there, arrives while it plays.
    const swap = await grab(p, 4, (e) => e.player.load('/knight.s4d?v=2', { keep: true }));
    for (const f of [...once, ...fast]) assert.equal(f.said, f.time, 'currentTime is the time that is shown');
    await compare(p, t, `${backend}-1x`, once);
    await compare(p, t, `${backend}-4x`, fast);
    await compare(p, t, `${backend}-jumps`, [...jumps, ...swap]);
    const rates = [pace(once.slice(5), length, 1), pace(fast.slice(5), length, 4)];
    t.diagnostic(`scene seconds a second: ${rates.map((r) => r.toFixed(2)).join(', ')}`);
    for (const rate of rates) assert.ok(Math.abs(rate - 1) <= REAL_TIME, `${rate} of real time`);
    assert.deepEqual(errors, []);
  });
}

test('a camera path moves camera and time together', options, async (t) => {
  const { page: p } = await page(element('backend="webgl2" resolution="1"'), t);
  await ready(p);
  await p.evaluate(HELP);
  const frames = await grab(p, 12, (e) => {
    const { player } = e;
    player.track.keys = [];
    player.track.add(player.camera, 0);
    const other = player.camera.clone();
    other.position = other.position.map((x, k) => x + [0.3, 0.1, 0][k]);
    player.track.add(other, 0.9);
    player.playFilm();
  });
  await compare(p, t, 'path', frames);
});

for (const backend of ['webgl2', 'webgpu']) {
  test(`${backend}: the first image after pausing has full resolution and shows the same time`, options, async (t) => {
    const { page: p } = await page(element(`backend="${backend}"`), t);
    await ready(p);
    const seen = await p.evaluate(
      async (width) => {
        const e = document.querySelector('splat-4d'),
          { player } = e,
          { backend } = player;
        const frame = () => new Promise(requestAnimationFrame);
        e.play();
        // Playing lowers it on a slow device.
        while (!(e.statistics.scale < 0.5)) await frame();
        for (let end = performance.now() + 1500; performance.now() < end; ) await frame();
        const times = [],
          widths = [],
          draw = backend.draw.bind(backend);
        backend.draw = (what) => {
          const drawn = draw(what);
          if (drawn !== false) widths.push(player.canvas.width);
          return drawn;
        };
        const flying = backend.flight.count,
          began = performance.now(),
          at = e.currentTime,
          before = player.canvas.width;
        e.addEventListener('timeupdate', ({ detail }) => times.push(detail.time));
        e.pause();
        // An image that the GPU works on is finished first: no more than one passes before the request.
        let frames = 0;
        for (let free = 0; free < 2 && !widths.length; free += !backend.flight.count, frames++) await frame();
        const first = widths[0];
        while (backend.flight.count || player.canvas.width !== width) await frame();
        const ms = performance.now() - began;
        await e.settled();
        return { before, first, frames, flying, ms, cost: backend.flight.ms, times, at, now: e.currentTime };
      },
      WIDTH,
    );
    t.diagnostic(`${seen.flying} in flight, requested in animation frame ${seen.frames}, there after ${seen.ms.toFixed(0)} ms, ` +
      `of which the image itself ${seen.cost.toFixed(0)} ms`);
    assert.ok(seen.before < WIDTH, 'playing lowers the resolution');
    assert.equal(seen.first, WIDTH);
    assert.deepEqual([seen.times, seen.now], [[], seen.at], 'no other time is shown');
  });
}

const TURNING = `<canvas width="${WIDTH}" height="${HEIGHT}"></canvas><script type="module">
  import * as THREE from 'three';
  import { Splat4D } from 'splat4d/three';
  const canvas = document.querySelector('canvas');
  const renderer = new THREE.WebGLRenderer({ canvas, preserveDrawingBuffer: true });
  renderer.setSize(${WIDTH}, ${HEIGHT}, false);
  const scene = new THREE.Scene(), take = new Splat4D('/knight.s4d');
  scene.add(take);
  await take.ready;
  const c = take.meta.cameras[0], m = c.world_from_camera;
  const camera = new THREE.PerspectiveCamera(2 * Math.atan(c.height / 2 / c.fy) * 180 / Math.PI, 4 / 3, 0.05, 100);
  camera.matrixAutoUpdate = false;
  camera.matrix.set(m[0], -m[1], -m[2], m[3], m[4], -m[5], -m[6], m[7], m[8], -m[9], -m[10], m[11], 0, 0, 0, 1);
  scene.add(camera);
  scene.background = new THREE.Color().setRGB(...take.meta.background, THREE.SRGBColorSpace);
  renderer.render(scene, camera);
  await take.settled();
  /// Plays by setting the clock, as a page of its own does; \`own\`: the object plays.
  window.film = async (frames, own) => {
    const out = [];
    if (own) take.play();
    const [a, b, d] = [[0, 1, 2], [4, 5, 6], [8, 9, 10]].map((row) => row.map((k) => m[k]));
    const pose = [0, 1, 2].flatMap((k) => {
      const axis = [a[k], b[k], d[k]];
      return [...axis, -(axis[0] * m[3] + axis[1] * m[7] + axis[2] * m[11])];
    });
    let shown = null;
    while (out.length < frames) {
      const now = await new Promise(requestAnimationFrame);
      if (!own) take.time = take.meta.clip[0] + (now / 1000) % take.duration;
      renderer.render(scene, camera);
      const time = take.renderedTime;
      if (time === shown) continue;
      shown = time;
      out.push({ time, pose, fov: camera.fov, wall: performance.now(), rgba: window.copyOf(canvas), wanted: take.time });
    }
    return out;
  };
  window.still = async () => {
    take.pause();
    const before = take.renderedTime;
    renderer.render(scene, camera);
    await take.settled();
    renderer.render(scene, camera);
    return [before, take.renderedTime, take.time, take.paused];
  };
  window.upright = async (up) => {
    const other = new Splat4D('/knight.s4d', { up });
    await other.ready;
    const v = new THREE.Vector3(...other.meta.up).applyMatrix4(other.objectFromFile);
    other.dispose();
    return [v.x, v.y, v.z].map((x) => Math.round(1e6 * x) / 1e6 + 0);
  };
  window.shown = true;
</script>`;

const three = { skip: options.skip || (existsSync(THREE) ? false : 'needs three') };
test('the object in three.js shows frames that exist', three, async (t) => {
  const { page: p, errors } = await page(TURNING, t);
  await p.evaluate(HELP);
  await p.waitForFunction(() => window.shown, null, { timeout: 60000 });
  const frames = await p.evaluate((n) => window.film(n), FRAMES);
  const own = await p.evaluate(() => window.film(8, true));
  const [before, shown, time, paused] = await p.evaluate(() => window.still());
  assert.deepEqual([shown, time, paused], [before, before, true], 'it stops at the image that is shown');
  await compare(p, t, 'three', [...frames, ...own]);
  assert.deepEqual(await p.evaluate(async () => [await window.upright('z'), await window.upright(null)]), [[0, 0, 1], [0, 1, 0]]);
  assert.deepEqual(errors, []);
});

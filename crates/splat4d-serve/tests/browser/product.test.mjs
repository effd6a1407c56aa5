// The product as people get it: the program serves a trained scene, Chromium shows it. Images against the CPU renderer,
// bytes of a first image and of a seek, broken files, a bare page with the element, one page opened from the disk.
// SPLAT4D names the program; without it these tests are skipped.

import assert from 'node:assert/strict';
import { execFileSync, spawn } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath, pathToFileURL } from 'node:url';
import { launch, open } from './browser.mjs';
import { psnr } from './reference.mjs';
import { sample } from './sample.mjs';

/// Images against the CPU renderer, dB.
const BOUND = 35;
/// Of a long take the first image may read this share.
const FIRST_SHARE = 0.2;
/// Rounds of the bundled capture: more than 20 seconds.
const ROUNDS = 21;

const KNIGHT = fileURLToPath(new URL('../../../../examples/knight.s4d', import.meta.url));
const PROGRAM = process.env.SPLAT4D;
const browser = PROGRAM && existsSync(PROGRAM) ? await launch() : null;
const options = { skip: browser ? false : 'needs the program (SPLAT4D) and a browser' };
const work = mkdtempSync(path.join(tmpdir(), 'splat4d-'));
const servers = [];
test.after(async () => {
  servers.forEach((s) => s.kill('SIGINT'));
  await browser?.close();
  rmSync(work, { recursive: true });
});

const run = (...args) => execFileSync(PROGRAM, args, { stdio: ['ignore', 'pipe', 'ignore'] });

/// Starts `splat4d view` and waits for its address.
function view(file) {
  const child = spawn(PROGRAM, ['view', file, '--no-open', '--json', '--port', '0'], { stdio: ['ignore', 'pipe', 'inherit'] });
  servers.push(child);
  return new Promise((found, failed) => {
    let text = '';
    child.stdout.on('data', (data) => {
      text += data;
      const line = text.split('\n').find((l) => l.includes('"serving"'));
      if (line) found(JSON.parse(line).url);
    });
    child.on('exit', (code) => failed(new Error(`view ended with ${code}`)));
  });
}

/// A page with nothing but the element, on the server's own origin.
async function bare(url, attributes, size = { width: 400, height: 300 }) {
  const base = url.replace(/\/$/, '');
  const page = await browser.newPage({ viewport: size });
  const errors = [];
  page.on('console', (m) => m.type() === 'error' && errors.push(m.text()));
  page.on('pageerror', (e) => errors.push(e.stack ?? e.message));
  const body = `<!doctype html><link rel="icon" href="data:,"><style>body{margin:0}splat-4d{display:block;width:100vw;height:100vh}</style>
    <splat-4d src="/scene.s4d" ${attributes}></splat-4d><script type="module" src="/player/element.js"></script>`;
  await page.route(`${base}/bare.html`, (r) => r.fulfill({ contentType: 'text/html', body }));
  await page.goto(`${base}/bare.html`);
  await page.waitForFunction(() => document.querySelector('splat-4d').statistics?.firstFrame > 0, null, { timeout: 60000 });
  return { page, errors };
}

/// A PNG's pixels as RGBA, decoded by the page.
const pixels = (page, png) =>
  page.evaluate(async (base64) => {
    const picture = await createImageBitmap(await (await fetch(`data:image/png;base64,${base64}`)).blob(), {
      colorSpaceConversion: 'none',
    });
    const canvas = new OffscreenCanvas(picture.width, picture.height);
    const draw = canvas.getContext('2d');
    draw.drawImage(picture, 0, 0);
    return [...draw.getImageData(0, 0, picture.width, picture.height).data];
  }, png.toString('base64'));

const shot = async (page) =>
  Buffer.from(
    await page.evaluate(async () => {
      const bytes = new Uint8Array(await (await document.querySelector('splat-4d').screenshot()).arrayBuffer());
      return btoa(Array.from(bytes, (b) => String.fromCharCode(b)).join(''));
    }),
    'base64',
  );

/// What the element shows from the camera `c` of a file at `time`, as RGBA.
async function seen(page, c, time) {
  const m = c.world_from_camera,
    fov = (2 * Math.atan(c.height / 2 / c.fy) * 180) / Math.PI;
  await page.evaluate(
    async ([position, target, fov, time]) => {
      const e = document.querySelector('splat-4d');
      e.pause();
      e.camera = { position, target, fov };
      e.seek(time);
      await e.settled();
    },
    [[m[3], m[7], m[11]], [m[3] + m[2], m[7] + m[6], m[11] + m[10]], fov, time],
  );
  return pixels(page, await shot(page));
}

/// What the CPU renderer makes of a file from its camera `name` at `time`, as RGBA; `picture` names a file to use.
function rendered(page, scene, name, time, picture) {
  // A film of one camera at one second is one image.
  run('render', scene, '--device', 'cpu', '--path', `camera=${name}`, '--freeze', String(time), '-o', picture);
  return pixels(page, readFileSync(picture));
}

for (const backend of ['webgl2', 'webgpu']) {
  test(`${backend} matches the CPU renderer without the Gaussians that key masks hide`, options, async (t) => {
    const camera = { name: 'front', world_from_camera: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], width: 400, height: 300 };
    const made = { masks: 0.5, json: { cameras: [{ ...camera, fx: 375, fy: 375, cx: 200, cy: 150 }] } };
    const put = (name, options) => {
      const file = path.join(work, `${backend}-${name}`);
      writeFileSync(file, sample({ ...made, ...options }).bytes);
      return file;
    };
    const url = await view(put('masked.s4d', {}));
    const { page, errors } = await bare(url, `backend="${backend}" resolution="1" controls="none"`);
    const [c] = await page.evaluate(() => document.querySelector('splat-4d').player.meta.cameras);
    const whole = put('whole.s4d', { masks: 0 });
    // Between two key times, and on one.
    for (const time of [2.2, 3.5]) {
      const mine = await seen(page, c, time);
      const picture = path.join(work, `${backend}-masked.png`);
      const db = psnr(mine, await rendered(page, put('without.s4d', { without: time }), c.name, time, picture));
      const unmasked = psnr(mine, await rendered(page, whole, c.name, time, picture));
      t.diagnostic(`at ${time} s: ${db.toFixed(1)} dB, against all Gaussians ${unmasked.toFixed(1)} dB`);
      assert.ok(db >= BOUND && unmasked < BOUND, `at ${time}: ${db} and ${unmasked} dB`);
    }
    assert.deepEqual(errors, []);
    await page.close();
  });

  test(`${backend} renders the bundled capture like the CPU renderer`, options, async (t) => {
    const url = await view(KNIGHT);
    const { page, errors } = await bare(url, `backend="${backend}" resolution="1" controls="none"`);
    const named = await page.evaluate(() => document.querySelector('splat-4d').player.meta.cameras);
    for (const [name, time] of [['cam03', 0.2], ['cam11', 0.7]]) {
      const c = named.find((camera) => camera.name === name);
      const mine = await seen(page, c, time);
      const truth = await rendered(page, KNIGHT, name, time, path.join(work, `${backend}-${name}.png`));
      assert.equal(mine.length, truth.length);
      const db = psnr(mine, truth);
      t.diagnostic(`${name} at ${time} s: ${db.toFixed(1)} dB`);
      assert.ok(db >= BOUND, `${name}: ${db} dB`);
    }
    assert.equal(await page.evaluate(() => document.querySelector('splat-4d').statistics.backend), backend);
    assert.deepEqual(errors, []);
    await page.close();
  });
}

test('a long capture starts with a fraction of its bytes, and a seek fetches its own', options, async (t) => {
  const long = path.join(work, 'long.s4d');
  run('bake', KNIGHT, '-o', long, '--repeat', String(ROUNDS));
  const { page, errors } = await bare(await view(long), 'backend="webgl2" resolution="0.5" controls="none"');
  const first = await page.evaluate(() => document.querySelector('splat-4d').statistics);
  const share = first.bytesRead / first.bytesTotal;
  t.diagnostic(`first picture after ${first.firstFrame.toFixed(0)} ms, ${(100 * share).toFixed(1)} % of ${first.bytesTotal} bytes`);
  assert.ok(share <= FIRST_SHARE, `${share}`);
  const seeks = await page.evaluate(async () => {
    const e = document.querySelector('splat-4d');
    e.pause();
    const out = [];
    for (const share of [0.52, 0.13, 0.88, 0.31]) {
      const [before, began] = [e.statistics.bytesRead, performance.now()];
      e.seek(e.duration * share);
      await e.settled();
      out.push({ ms: performance.now() - began, bytes: e.statistics.bytesRead - before });
      await new Promise((r) => setTimeout(r, 500)); // what lies ahead comes in the meantime
    }
    return out;
  });
  t.diagnostic(`seeks: ${seeks.map((s) => `${s.ms.toFixed(0)} ms, ${s.bytes} bytes`).join('; ')}`);
  // Its own pages and those of the next two seconds, no more.
  for (const s of seeks) assert.ok(s.bytes > 0 && s.bytes < (4 * first.bytesTotal) / ROUNDS, `${s.bytes}`);
  assert.deepEqual(errors, []);
  await page.close();
});

test('a broken file is a message, not a blank page', options, async () => {
  const bytes = Buffer.from(readFileSync(KNIGHT));
  bytes[70] ^= 1;
  const file = path.join(work, 'broken.s4d');
  writeFileSync(file, bytes);
  // The program itself refuses it; a page elsewhere might not.
  assert.throws(() => run('view', file, '--no-open'));
  const url = await view(KNIGHT);
  const page = await browser.newPage();
  await page.route('**/scene.s4d*', (r) => r.fulfill({ body: bytes }));
  await page.goto(url);
  const alert = page.getByRole('alert').first();
  await alert.waitFor({ timeout: 20000 });
  assert.match(await alert.innerText(), /checksum|damaged|broken/i);
  await page.close();
});

test('one page holds player and scene, and plays from the disk', options, async () => {
  const file = path.join(work, 'one.html');
  run('export', KNIGHT, '--html', '-o', file);
  const { page, errors } = await open(browser, pathToFileURL(file).href, { viewport: { width: 400, height: 300 } });
  const outside = [];
  page.on('request', (r) => /^https?:/.test(r.url()) && outside.push(r.url()));
  await page.waitForFunction(() => document.querySelector('splat-4d')?.statistics?.firstFrame > 0, null, { timeout: 60000 });
  assert.deepEqual([errors, outside], [[], []]);
  await page.close();
});

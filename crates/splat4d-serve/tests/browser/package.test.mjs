// The player as npm delivers it: packed, installed from the tarball into an empty folder, and used by pages: the
// element, and the object of three.js, with meshes before and behind it, in the oldest and the newest three.js that the
// package accepts. Needs npm, and both next to playwright-core (`.ci/run`).

import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, readdirSync, rmSync, statSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { gzipSync } from 'node:zlib';
import { launch, open } from './browser.mjs';
import { psnr } from './reference.mjs';
import { serve } from './server.mjs';

const PACKAGE = fileURLToPath(new URL('../../npm/', import.meta.url));
const KNIGHT = readFileSync(fileURLToPath(new URL('../../../../examples/knight.s4d', import.meta.url)));
/// Bytes of all its modules, gzipped one by one as servers send them.
const MOST = 106_500;
/// The element and the object against each other, dB: one blends in half floats, the other in the canvas' bytes.
const ALIKE = 32;
const MODULES = path.join(process.env.PLAYWRIGHT ?? '', 'node_modules');
/// The newest three.js, and the oldest that `peerDependencies` accept, as `.ci/npm` installs them.
const THREES = ['three', 'three-oldest'];

const browser = await launch();
const work = mkdtempSync(path.join(tmpdir(), 'splat4d-npm-'));
const npm = (...args) => execFileSync('npm', args, { cwd: args[0] === 'pack' ? PACKAGE : work, stdio: ['ignore', 'pipe', 'ignore'] });
const tarball = String(npm('pack', '--silent', '--pack-destination', work)).trim();
npm('install', '--offline', '--no-audit', '--no-fund', '--no-save', '--prefix', work, path.join(work, tarball));
const installed = path.join(work, 'node_modules/splat4d');
test.after(async () => {
  await browser?.close();
  rmSync(work, { recursive: true });
});

const MAP = { imports: { splat4d: '/splat4d/player/element.js', 'splat4d/three': '/splat4d/three.js', three: '/three/three.module.js' } };
const html = (body) => `<!doctype html><link rel="icon" href="data:,"><style>body{margin:0}</style>
  <script type="importmap">${JSON.stringify(MAP)}</script>${body}`;

/// A page of this body, next to the installed package, a scene and a three.js.
async function page(body, t, three = THREES[0]) {
  const folders = { '/splat4d/': installed, '/three/': path.join(MODULES, three, 'build') };
  const server = await serve({ files: { 'page.html': html(body), 'knight.s4d': KNIGHT }, folders });
  const opened = await open(browser, server.url + 'page.html', { viewport: { width: 400, height: 300 } });
  t.after(() => Promise.all([opened.page.close(), server.close()]));
  return opened;
}

test('the package contains its exports, and is small', (t) => {
  const manifest = JSON.parse(readFileSync(path.join(installed, 'package.json')));
  const named = Object.values(manifest.exports).flatMap((e) => (typeof e === 'string' ? [] : Object.values(e)));
  // What a loader imports is in the package too.
  named.push('./engine.js');
  for (const file of [...named, 'README.md', 'LICENSE-MIT', 'LICENSE-APACHE']) assert.ok(existsSync(path.join(installed, file)), file);
  const all = ['three.js', ...readdirSync(path.join(installed, 'player')).map((f) => `player/${f}`)];
  const bytes = all.reduce((sum, f) => sum + gzipSync(readFileSync(path.join(installed, f))).length, 0);
  t.diagnostic(`${all.length} modules, ${bytes} bytes as gzip; the tarball ${statSync(path.join(work, tarball)).size} bytes`);
  assert.ok(bytes <= MOST);
});

const needs = (three) => ({ skip: !browser ? 'needs a browser' : three && !existsSync(path.join(MODULES, three)) ? `needs ${three}` : false });
const ELEMENT = `<splat-4d src="/knight.s4d" backend="webgl2" resolution="1" controls="none"
  style="display:block;width:400px;height:300px"></splat-4d><script type="module">import 'splat4d';</script>`;
/// three.js with the knight, seen by the file's camera \`at\`; the page states \`shown\` when it is drawn.
const OBJECT = `<canvas width="400" height="300"></canvas><script type="module">
  import * as THREE from 'three';
  import { Splat4D } from 'splat4d/three';
  const renderer = new THREE.WebGLRenderer({ canvas: document.querySelector('canvas'), preserveDrawingBuffer: true });
  renderer.setSize(400, 300, false);
  const scene = new THREE.Scene(), take = new Splat4D('/knight.s4d');
  scene.add(take);
  await take.ready;
  const c = take.meta.cameras[0], m = c.world_from_camera, camera = new THREE.PerspectiveCamera(
    2 * Math.atan(c.height / 2 / c.fy) * 180 / Math.PI, 4 / 3, 0.05, 100);
  camera.matrixAutoUpdate = false;
  camera.matrix.set(m[0], -m[1], -m[2], m[3], m[4], -m[5], -m[6], m[7], m[8], -m[9], -m[10], m[11], 0, 0, 0, 1);
  scene.background = new THREE.Color().setRGB(...take.meta.background, THREE.SRGBColorSpace);
  /// A red square across the view at a distance from the camera.
  const square = new THREE.Mesh(new THREE.PlaneGeometry(100, 100), new THREE.MeshBasicMaterial({ color: 0xff0000 }));
  square.visible = false;
  camera.add(square);
  scene.add(camera);
  window.show = async (time, distance, place) => {
    take.time = time;
    take.position.set(...(place ?? [0, 0, 0]));
    square.visible = distance > 0;
    square.position.z = -distance;
    renderer.render(scene, camera);
    await take.settled();
    renderer.render(scene, camera);
    const copy = new OffscreenCanvas(400, 300), draw = copy.getContext('2d');
    draw.drawImage(renderer.domElement, 0, 0);
    return [...draw.getImageData(0, 0, 400, 300).data];
  };
  window.camera = m;
  window.fov = camera.fov;
  window.dispose = () => { take.dispose(); return renderer.info.memory.textures; };
  window.shown = true;
</script>`;

test('an installed element plays', needs(null), async (t) => {
  const { page: p, errors } = await page(ELEMENT.replace('backend', 'autoplay backend'), t);
  await p.waitForFunction(() => document.querySelector('splat-4d').statistics?.firstFrame > 0, null, { timeout: 60000 });
  await p.waitForFunction(() => document.querySelector('splat-4d').currentTime > 0.1, null, { timeout: 60000 });
  assert.deepEqual(errors, []);
});

test('the accepted three.js is tested from its oldest version on', needs('three-oldest'), () => {
  const oldest = JSON.parse(readFileSync(path.join(MODULES, 'three-oldest/package.json'))).version;
  const { peerDependencies } = JSON.parse(readFileSync(path.join(installed, 'package.json')));
  assert.equal(`${peerDependencies.three}.0`, `>=${oldest}`);
});

for (const three of THREES) test(`the object of ${three} matches the element, among meshes`, needs(three), async (t) => {
  const { page: p, errors } = await page(OBJECT, t, three);
  await p.waitForFunction(() => window.shown, null, { timeout: 60000 });
  const show = (...args) => p.evaluate((a) => window.show(...a), args);
  const [m, fov] = await p.evaluate(() => [window.camera, window.fov]);
  const other = await page(ELEMENT, t);
  await other.page.waitForFunction(() => document.querySelector('splat-4d').statistics?.firstFrame > 0, null, { timeout: 60000 });
  for (const time of [0.5]) {
    const mine = await show(time, 0);
    const element = await other.page.evaluate(
      async ([position, target, fov, time]) => {
        const e = document.querySelector('splat-4d');
        e.camera = { position, target, fov };
        e.seek(time);
        await e.settled();
        const picture = await createImageBitmap(await e.screenshot());
        const draw = new OffscreenCanvas(picture.width, picture.height).getContext('2d');
        draw.drawImage(picture, 0, 0);
        return [...draw.getImageData(0, 0, picture.width, picture.height).data];
      },
      [[m[3], m[7], m[11]], [m[3] + m[2], m[7] + m[6], m[11] + m[10]], fov, time],
    );
    const db = psnr(mine, element);
    t.diagnostic(`at ${time} s: ${db.toFixed(1)} dB`);
    assert.ok(db >= ALIKE, `${db} dB at ${time} s`);
  }
  // Red before everything hides it; behind everything only shows where nothing covers; in between, some of both.
  const red = (data) => {
    let n = 0;
    for (let i = 0; i < data.length; i += 4) n += data[i] > 200 && data[i + 1] < 60 && data[i + 2] < 60;
    return n / (data.length / 4);
  };
  const [before, within, behind] = [red(await show(0.5, 0.1)), red(await show(0.5, Math.hypot(m[3], m[7], m[11] - 0.8))), red(await show(0.5, 50))];
  t.diagnostic(`red before ${before.toFixed(3)}, within ${within.toFixed(3)}, behind ${behind.toFixed(3)}`);
  assert.ok(before > 0.99 && behind < within && within < before - 0.02, `${before} ${within} ${behind}`);
  // Moved out of the image, nothing of it is left.
  const away = await show(0.5, 50, [0, 0, 1000]);
  assert.ok(red(away) > 0.99);
  assert.ok((await p.evaluate(() => window.dispose())) === 0, 'its textures are given back');
  assert.deepEqual([...errors, ...other.errors], []);
});

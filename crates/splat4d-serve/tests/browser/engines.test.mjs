// The scene inside Spark, PlayCanvas and Babylon.js as npm delivers them, against the player's own image. Needs esbuild and the
// engines next to playwright-core (`.ci/run`).

import assert from 'node:assert/strict';
import { existsSync, readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { launch, open } from './browser.mjs';
import { psnr } from './reference.mjs';
import { serve } from './server.mjs';

const NPM = fileURLToPath(new URL('../../npm/', import.meta.url));
const KNIGHT = readFileSync(fileURLToPath(new URL('../../../../examples/knight.s4d', import.meta.url)));
const MODULES = path.join(process.env.PLAYWRIGHT ?? '', 'node_modules');
const [WIDTH, HEIGHT] = [400, 300];
const TIMES = [0.1, 0.5, 0.9];
/// Least agreement with the player, dB. The engines cut Gaussians off at other distances, and store them in fewer bits.
const ALIKE = 35;
/// What of each engine is bundled into one module.
const PLAYCANVAS = [
  'Application', 'BoundingBox', 'Color', 'Entity', 'FILLMODE_NONE', 'GSplatContainer', 'GSplatFormat', 'Mat4', 'PIXELFORMAT_RGBA32F',
  'Quat', 'RenderTarget', 'RESOLUTION_FIXED', 'Texture', 'Vec3',
];
const BABYLON = ['Color4', 'Engine', 'FreeCamera', 'GaussianSplattingMesh', 'Matrix', 'Quaternion',
  'RenderTargetTexture', 'Scene', 'TransformNode', 'Vector3'];

const there = (name) => existsSync(path.join(MODULES, name, 'package.json'));
const browser = await launch();
test.after(() => browser?.close());

/// An engine's module with all it imports, but `external`.
async function bundle(text, external = []) {
  const esbuild = createRequire(path.join(MODULES, 'x.js'))('esbuild');
  const { outputFiles } = await esbuild.build({
    stdin: { contents: text, resolveDir: path.dirname(MODULES) }, bundle: true, format: 'esm', write: false, external, logLevel: 'silent',
  });
  return outputFiles[0].text;
}

const exported = (names, from) => `export { ${names.join(', ')} } from '${from}';`;

/// What all pages begin with: the camera of the file, as its 12 numbers.
const HEAD = `const WIDTH = ${WIDTH}, HEIGHT = ${HEIGHT};
  const canvas = document.querySelector('canvas');
  // Rows of floats from below become rows of bytes from above. Like the player, the engines blend in floats here: in the bytes
  // of a canvas each Gaussian is rounded, which costs more than the loaders' own differences.
  const bytes = (floats) => {
    const out = [];
    for (let y = HEIGHT - 1; y >= 0; y--)
      for (let i = 4 * WIDTH * y; i < 4 * WIDTH * (y + 1); i++) out.push(Math.round(255 * Math.min(Math.max(floats[i], 0), 1)));
    return out;
  };
  const frames = async (n) => { for (let i = 0; i < n; i++) await new Promise((done) => setTimeout(done, 60)); };
  const view = (meta) => {
    const c = meta.cameras[0], m = c.world_from_camera;
    return { m, fov: 2 * Math.atan(c.height / 2 / c.fy) * 180 / Math.PI };
  };`;

const THREE_PAGE = `
  import * as THREE from 'three';
  import { SparkRenderer } from '@sparkjsdev/spark';
  import { Splat4D } from 'splat4d/spark';
  ${HEAD}
  const renderer = new THREE.WebGLRenderer({ canvas, preserveDrawingBuffer: true, antialias: false });
  renderer.setSize(WIDTH, HEIGHT, false);
  const scene = new THREE.Scene(), take = new Splat4D('/knight.s4d'), spark = new SparkRenderer({ renderer, accumExtSplats: true });
  scene.add(spark, take);
  await take.ready;
  const { m, fov } = view(take.frames.meta), camera = new THREE.PerspectiveCamera(fov, WIDTH / HEIGHT, 0.01, 1000);
  camera.matrixAutoUpdate = false;
  const pose = new THREE.Matrix4().set(m[0], -m[1], -m[2], m[3], m[4], -m[5], -m[6], m[7], m[8], -m[9], -m[10], m[11], 0, 0, 0, 1);
  take.mesh.updateWorldMatrix(true, false);
  camera.matrix.multiplyMatrices(take.mesh.matrixWorld, pose);
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  // A target has linear light by default; what is written to it here are display values.
  scene.background = new THREE.Color(...take.frames.meta.background);
  const target = new THREE.WebGLRenderTarget(WIDTH, HEIGHT, { type: THREE.FloatType });
  renderer.setRenderTarget(target);
  window.show = async (time) => {
    await take.load(time);
    for (let i = 0; i < 12; i++) {
      take.update(camera);
      renderer.render(scene, camera);
      await new Promise((done) => setTimeout(done, 60));
    }
    const floats = new Float32Array(4 * WIDTH * HEIGHT);
    renderer.readRenderTargetPixels(target, 0, 0, WIDTH, HEIGHT, floats);
    return bytes(floats);
  };
  window.shown = true;`;

const PLAYCANVAS_PAGE = `
  import {
    Application, Color, Entity, FILLMODE_NONE, Mat4, PIXELFORMAT_RGBA32F, Quat, RenderTarget, RESOLUTION_FIXED, Texture,
  } from 'playcanvas';
  import { Splat4D } from 'splat4d/playcanvas';
  ${HEAD}
  const app = new Application(canvas, { graphicsDeviceOptions: { antialias: false, preserveDrawingBuffer: true } });
  app.setCanvasFillMode(FILLMODE_NONE);
  app.setCanvasResolution(RESOLUTION_FIXED, WIDTH, HEIGHT);
  app.start();
  const take = new Splat4D(app, '/knight.s4d', { up: null });
  app.root.addChild(take.entity);
  await take.ready;
  const { m, fov } = view(take.frames.meta), camera = new Entity('camera');
  camera.addComponent('camera', { fov, nearClip: 0.01, farClip: 1000, clearColor: new Color(...take.frames.meta.background) });
  app.root.addChild(camera);
  const texture = new Texture(app.graphicsDevice, { width: WIDTH, height: HEIGHT, format: PIXELFORMAT_RGBA32F, mipmaps: false });
  const renderTarget = new RenderTarget({ colorBuffer: texture, depth: true });
  camera.camera.renderTarget = renderTarget;
  const pose = new Mat4();
  pose.data.set([m[0], m[4], m[8], 0, -m[1], -m[5], -m[9], 0, -m[2], -m[6], -m[10], 0, m[3], m[7], m[11], 1]);
  camera.setPosition(pose.getTranslation());
  camera.setRotation(new Quat().setFromMat4(pose));
  app.on('update', () => take.update(camera));
  window.show = async (time) => {
    await take.load(time);
    await frames(12);
    return bytes(await texture.read(0, 0, WIDTH, HEIGHT, { renderTarget, immediate: true }));
  };
  window.shown = true;`;

const BABYLON_PAGE = `
  import { Color4, Engine, FreeCamera, RenderTargetTexture, Scene, Vector3 } from '@babylonjs/core';
  import { Splat4D } from 'splat4d/babylon';
  ${HEAD}
  const engine = new Engine(canvas, false, { preserveDrawingBuffer: true });
  const scene = new Scene(engine);
  scene.useRightHandedSystem = true;
  const take = new Splat4D('/knight.s4d', scene, { up: null });
  await take.ready;
  const { m, fov } = view(take.frames.meta), camera = new FreeCamera('camera', new Vector3(m[3], m[7], m[11]), scene);
  camera.fov = fov * Math.PI / 180;
  camera.minZ = 0.01;
  camera.maxZ = 1000;
  camera.upVector = new Vector3(-m[1], -m[5], -m[9]);
  camera.setTarget(new Vector3(m[3] + m[2], m[7] + m[6], m[11] + m[10]));
  scene.clearColor = new Color4(...take.frames.meta.background, 1);
  const target = new RenderTargetTexture('target', { width: WIDTH, height: HEIGHT }, scene, false, true, Engine.TEXTURETYPE_FLOAT);
  camera.outputRenderTarget = target;
  engine.runRenderLoop(() => scene.render());
  window.show = async (time) => {
    await take.load(time);
    await frames(20);
    return bytes(await target.readPixels());
  };
  window.shown = true;`;

/// name → [npm's packages, the page, modules of the import map: name → text].
const ENGINES = {
  Spark: [['@sparkjsdev/spark', 'three'], THREE_PAGE, async () => ({
    three: await bundle("export * from 'three';"),
    '@sparkjsdev/spark': await bundle("export * from '@sparkjsdev/spark';", ['three']),
  })],
  PlayCanvas: [['playcanvas'], PLAYCANVAS_PAGE, async () => ({ playcanvas: await bundle(exported(PLAYCANVAS, 'playcanvas')) })],
  'Babylon.js': [['@babylonjs/core'], BABYLON_PAGE, async () => ({
    '@babylonjs/core': await bundle(exported(BABYLON, '@babylonjs/core')),
  })],
};

async function page(body, modules, t) {
  const files = { 'knight.s4d': KNIGHT },
    imports = {};
  for (const name of ['frames', 'spark', 'playcanvas', 'babylon']) {
    // As in the package, where the player lies next to them.
    files[`splat4d/${name}.js`] = readFileSync(path.join(NPM, `${name}.js`), 'utf8');
    imports[`splat4d/${name}`] = `/splat4d/${name}.js`;
  }
  Object.entries(modules).forEach(([name, text], i) => {
    files[`engine${i}.js`] = text;
    imports[name] = `/engine${i}.js`;
  });
  files['page.html'] = `<!doctype html><link rel="icon" href="data:,"><style>body{margin:0}</style>
    <script type="importmap">${JSON.stringify({ imports })}</script>${body}`;
  const server = await serve({ files, folders: { '/splat4d/player/': path.join(NPM, '../player/') } });
  const opened = await open(browser, server.url + 'page.html', { viewport: { width: WIDTH, height: HEIGHT } });
  t.after(() => Promise.all([opened.page.close(), server.close()]));
  return opened;
}

const ELEMENT = `<splat-4d src="/knight.s4d" backend="webgl2" resolution="1" controls="none"
  style="display:block;width:${WIDTH}px;height:${HEIGHT}px"></splat-4d><script type="module">import '/splat4d/player/element.js';</script>`;

let references = null;
/// The player's images of the file's first camera.
async function player(t) {
  if (references) return references;
  const { page: p } = await page(ELEMENT, {}, t);
  await p.waitForFunction(() => document.querySelector('splat-4d').statistics?.firstFrame > 0, null, { timeout: 180000 });
  const shots = [];
  for (const time of TIMES) {
    shots.push(
      await p.evaluate(async (time) => {
        const e = document.querySelector('splat-4d'),
          { SceneFile } = await import('/splat4d/player/scene-file.js'),
          c = (await SceneFile.open('/knight.s4d')).meta.cameras[0],
          m = c.world_from_camera;
        const position = [m[3], m[7], m[11]],
          // So far ahead that the player's near plane is that of the capture's cameras.
          target = [m[3] + 40 * m[2], m[7] + 40 * m[6], m[11] + 40 * m[10]];
        e.camera = { position, target, fov: (2 * Math.atan(c.height / 2 / c.fy) * 180) / Math.PI };
        e.seek(time);
        await e.settled();
        const picture = await createImageBitmap(await e.screenshot());
        const draw = new OffscreenCanvas(picture.width, picture.height).getContext('2d');
        draw.drawImage(picture, 0, 0);
        return [...draw.getImageData(0, 0, picture.width, picture.height).data];
      }, time),
    );
  }
  return (references = shots);
}

for (const [name, [packages, script, modules]] of Object.entries(ENGINES)) {
  const missing = [...packages, 'esbuild'].filter((p) => !there(p));
  const skip = !browser ? 'needs a browser' : missing.length ? `needs ${missing.join(', ')}` : false;
  if (skip && process.env.REQUIRE_ENGINES === '1') throw new Error(`${name} ${skip}`);
  test(`${name} shows what the player shows`, { skip }, async (t) => {
    const wanted = await player(t);
    const body = `<canvas width="${WIDTH}" height="${HEIGHT}" style="display:block"></canvas><script type="module">${script}</script>`;
    const { page: p, errors } = await page(body, await modules(), t);
    await p.waitForFunction(() => window.shown, null, { timeout: 180000 }).catch((e) => assert.fail(`${e.message} ${errors}`));
    for (const [i, time] of TIMES.entries()) {
      const have = await p.evaluate((time) => window.show(time), time);
      if (process.env.ENGINE_IMAGES) { //DEBUG
        const { writeFileSync } = await import('node:fs');
        writeFileSync(path.join(process.env.ENGINE_IMAGES, `${name}-${time}.json`), JSON.stringify([have, wanted[i]]));
      }
      const db = psnr(have, wanted[i]);
      t.diagnostic(`at ${time} s: ${db.toFixed(1)} dB`);
      assert.ok(db >= ALIKE, `${db} dB at ${time} s`);
    }
    assert.deepEqual(errors, []);
  });
}

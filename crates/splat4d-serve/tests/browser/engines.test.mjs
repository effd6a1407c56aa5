// The scene inside Spark, PlayCanvas and Babylon.js as npm delivers them, against the player's own image. Needs esbuild
// and the engines next to playwright-core (`.ci/run`).

import assert from 'node:assert/strict';
import { existsSync, readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { launch, open } from './browser.mjs';
import { psnr } from './reference.mjs';
import { sample } from './sample.mjs';
import { serve } from './server.mjs';

const NPM = fileURLToPath(new URL('../../npm/', import.meta.url));
/// Random Gaussians with spherical harmonics and key masks, few enough for engines that are computed on the CPU.
const SCENE = sample({ scale: 0.6, masks: 0.5 }).bytes;
const MODULES = path.join(process.env.PLAYWRIGHT ?? '', 'node_modules');
const [WIDTH, HEIGHT] = [240, 180];
/// Seconds that are sought; a third image is taken where the clock stops that plays on from the first.
const TIMES = [2.6, 5.2];
/// Least agreement with the player, dB.
const ALIKE = 35;
/// Longest that a page may take to start, ms: everything is computed on the CPU.
const PATIENCE = 180_000;
/// Names of each engine that are bundled into one module.
const PLAYCANVAS = [
  'Application', 'BoundingBox', 'Color', 'Entity', 'FILLMODE_NONE', 'GSplatContainer', 'GSplatFormat', 'Mat4', 'PIXELFORMAT_RGBA32F',
  'Quat', 'RenderTarget', 'RESOLUTION_FIXED', 'Texture', 'Vec3', 'WORKBUFFER_UPDATE_ONCE',
];
const BABYLON = [
  'Color4', 'Engine', 'FreeCamera', 'GaussianSplattingMesh', 'Matrix', 'Quaternion', 'RenderTargetTexture', 'Scene', 'TransformNode',
  'Vector3',
];

const there = (name) => existsSync(path.join(MODULES, name, 'package.json'));
const browser = await launch();
/// What is closed before the browser is.
const closing = [];
test.after(async () => {
  await Promise.all(closing.map((close) => close()));
  await browser?.close();
});

/// An engine's module with all it imports, but the module three itself, of which there may be only one.
async function bundle(text, external = null) {
  const esbuild = createRequire(path.join(MODULES, 'x.js'))('esbuild');
  const apart = (build) => build.onResolve({ filter: /^three$/ }, () => (external ? { path: 'three', external: true } : null));
  const { outputFiles } = await esbuild.build({
    stdin: { contents: text, resolveDir: path.dirname(MODULES) }, bundle: true, format: 'esm', write: false, logLevel: 'silent',
    plugins: [{ name: 'apart', setup: apart }],
  });
  return outputFiles[0].text;
}

const exported = (names, from) => `export { ${names.join(', ')} } from '${from}';`;

/// What all pages begin with. A page calls `shows` with a function that renders and returns the rows of floats, from
/// below.
const HEAD = `const WIDTH = ${WIDTH}, HEIGHT = ${HEIGHT}, canvas = document.querySelector('canvas');
  const bytes = (floats) => {
    const out = [];
    for (let y = HEIGHT - 1; y >= 0; y--)
      for (let i = 4 * WIDTH * y; i < 4 * WIDTH * (y + 1); i++) out.push(Math.round(255 * Math.min(Math.max(floats[i], 0), 1)));
    return out;
  };
  const pause = () => new Promise((done) => setTimeout(done, 300));
  // Engines sort in workers, and show what was there until the order is: an image is taken that is not the one before,
  // when three in a row are the same.
  let before = null;
  const same = (a, b) => a !== null && b !== null && a.every((x, i) => x === b[i]);
  const still = async (image) => {
    for (let last = null, times = 0; ; await pause()) {
      const now = bytes(await image());
      times = same(last, now) && !same(before, now) ? times + 1 : 0;
      if (times === 2) return (before = now);
      last = now;
    }
  };
  const view = (meta) => {
    const c = meta.cameras[0], m = c.world_from_camera;
    return { m, fov: 2 * Math.atan(c.height / 2 / c.fy) * 180 / Math.PI };
  };
  const shows = (object, image) => {
    window.seek = async (time) => {
      before ??= bytes(await image());
      await object.load(time);
      return await still(image);
    };
    window.play = async (until) => {
      object.frames.play();
      while (object.frames.time < until) { await image(); await pause(); }
      object.frames.pause();
      return { time: object.frames.time, image: await still(image) };
    };
    window.shown = true;
  };`;

const SPARK_PAGE = `
  import * as THREE from 'three';
  import { SparkRenderer } from '@sparkjsdev/spark';
  import { SETTINGS, Splat4D } from 'splat4d/spark';
  ${HEAD}
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
  renderer.setSize(WIDTH, HEIGHT, false);
  const scene = new THREE.Scene(), object = new Splat4D('/scene.s4d'), spark = new SparkRenderer({ renderer, ...SETTINGS });
  scene.add(spark, object);
  await object.ready;
  const { m, fov } = view(object.frames.meta), camera = new THREE.PerspectiveCamera(fov, WIDTH / HEIGHT, 0.01, 1000);
  const pose = new THREE.Matrix4().set(m[0], -m[1], -m[2], m[3], m[4], -m[5], -m[6], m[7], m[8], -m[9], -m[10], m[11], 0, 0, 0, 1);
  object.mesh.updateWorldMatrix(true, false);
  pose.premultiply(object.mesh.matrixWorld).decompose(camera.position, camera.quaternion, camera.scale);
  // On the canvas, whose colours are display values: in a render target Spark blends linear light.
  scene.background = new THREE.Color().setRGB(...object.frames.meta.background, THREE.SRGBColorSpace);
  const gl = renderer.getContext(), pixels = new Uint8Array(4 * WIDTH * HEIGHT);
  shows(object, () => {
    object.update(camera);
    renderer.render(scene, camera);
    gl.readPixels(0, 0, WIDTH, HEIGHT, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return Float32Array.from(pixels, (x) => x / 255);
  });
  window.dispose = () => {
    const before = renderer.info.memory.textures;
    object.dispose();
    return { left: scene.children.length - 1, freed: before - renderer.info.memory.textures };
  };`;

const PLAYCANVAS_PAGE = `
  import {
    Application, Color, Entity, FILLMODE_NONE, Mat4, PIXELFORMAT_RGBA32F, Quat, RenderTarget, RESOLUTION_FIXED, Texture,
  } from 'playcanvas';
  import { Splat4D } from 'splat4d/playcanvas';
  ${HEAD}
  const app = new Application(canvas, { graphicsDeviceOptions: { antialias: false } });
  app.setCanvasFillMode(FILLMODE_NONE);
  app.setCanvasResolution(RESOLUTION_FIXED, WIDTH, HEIGHT);
  app.autoRender = false;
  app.start();
  const object = new Splat4D(app, '/scene.s4d', { up: null });
  app.root.addChild(object.entity);
  await object.ready;
  const { m, fov } = view(object.frames.meta), camera = new Entity('camera');
  camera.addComponent('camera', { fov, nearClip: 0.01, farClip: 1000, clearColor: new Color(...object.frames.meta.background) });
  app.root.addChild(camera);
  const texture = new Texture(app.graphicsDevice, { width: WIDTH, height: HEIGHT, format: PIXELFORMAT_RGBA32F, mipmaps: false });
  const renderTarget = new RenderTarget({ colorBuffer: texture, depth: true });
  camera.camera.renderTarget = renderTarget;
  const pose = new Mat4();
  pose.data.set([m[0], m[4], m[8], 0, -m[1], -m[5], -m[9], 0, -m[2], -m[6], -m[10], 0, m[3], m[7], m[11], 1]);
  camera.setPosition(pose.getTranslation());
  camera.setRotation(new Quat().setFromMat4(pose));
  app.on('update', () => object.update(camera));
  const rendered = () => ((app.renderNextFrame = true), new Promise((done) => app.once('frameend', done)));
  shows(object, async () => {
    await rendered();
    return texture.read(0, 0, WIDTH, HEIGHT, { renderTarget, immediate: true });
  });
  window.dispose = async () => {
    const before = app.graphicsDevice._vram.tex;
    object.destroy();
    // The engine lets go of it with its next frames.
    for (let i = 0; i < 3; i++) await rendered();
    return { left: app.root.children.length - 1, freed: before - app.graphicsDevice._vram.tex };
  };`;

const BABYLON_PAGE = `
  import { Color4, Engine, FreeCamera, RenderTargetTexture, Scene, Vector3 } from '@babylonjs/core';
  import { Splat4D } from 'splat4d/babylon';
  ${HEAD}
  const engine = new Engine(canvas, false), scene = new Scene(engine);
  scene.useRightHandedSystem = true;
  const object = new Splat4D('/scene.s4d', scene, { up: null });
  await object.ready;
  const { m, fov } = view(object.frames.meta), camera = new FreeCamera('camera', new Vector3(m[3], m[7], m[11]), scene);
  camera.fov = fov * Math.PI / 180;
  camera.minZ = 0.01;
  camera.maxZ = 1000;
  camera.upVector = new Vector3(-m[1], -m[5], -m[9]);
  camera.setTarget(new Vector3(m[3] + m[2], m[7] + m[6], m[11] + m[10]));
  scene.clearColor = new Color4(...object.frames.meta.background, 1);
  const target = new RenderTargetTexture('target', { width: WIDTH, height: HEIGHT }, scene, false, true, Engine.TEXTURETYPE_FLOAT);
  camera.outputRenderTarget = target;
  shows(object, async () => {
    scene.render();
    return await target.readPixels();
  });
  window.dispose = () => {
    const before = scene.textures.length;
    object.dispose();
    return { left: scene.meshes.length + scene.transformNodes.length, freed: before - scene.textures.length };
  };`;

/// name → [npm's packages, the page, modules of the import map: name → text].
const ENGINES = {
  Spark: [['@sparkjsdev/spark', 'three'], SPARK_PAGE, async () => ({
    three: await bundle("export * from 'three';"),
    '@sparkjsdev/spark': await bundle("export * from '@sparkjsdev/spark';", 'three'),
  })],
  PlayCanvas: [['playcanvas'], PLAYCANVAS_PAGE, async () => ({ playcanvas: await bundle(exported(PLAYCANVAS, 'playcanvas')) })],
  'Babylon.js': [['@babylonjs/core'], BABYLON_PAGE, async () => ({
    '@babylonjs/core': await bundle(exported(BABYLON, '@babylonjs/core')),
  })],
};

async function page(body, modules, after) {
  // The file, and what is left of it after an upload that broke off.
  const files = { 'scene.s4d': SCENE, 'cut.s4d': SCENE.subarray(0, SCENE.length / 2) },
    imports = {};
  for (const name of ['frames', 'engine', 'spark', 'playcanvas', 'babylon']) {
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
  after(() => Promise.all([opened.page.close(), server.close()]));
  return opened;
}

const ELEMENT = `<splat-4d src="/scene.s4d" backend="webgl2" resolution="1" controls="none"
  style="display:block;width:${WIDTH}px;height:${HEIGHT}px"></splat-4d><script type="module">import '/splat4d/player/element.js';</script>`;

/// The player's page, for all engines.
let player = null;
async function start() {
  const { page: p } = await page(ELEMENT, {}, (done) => closing.push(done));
  await p.waitForFunction(() => document.querySelector('splat-4d').statistics?.firstFrame > 0, null, { timeout: PATIENCE });
  return p;
}

/// The player's image of the file's first camera at `time`.
async function shot(p, time) {
  return p.evaluate(async (time) => {
    const e = document.querySelector('splat-4d'),
      { SceneFile } = await import('/splat4d/player/scene-file.js'),
      c = (await SceneFile.open('/scene.s4d')).meta.cameras[0],
      m = c.world_from_camera;
    const position = [m[3], m[7], m[11]],
      // Far enough ahead that the player's near plane is that of the capture's cameras.
      target = [m[3] + 40 * m[2], m[7] + 40 * m[6], m[11] + 40 * m[10]];
    e.camera = { position, target, fov: (2 * Math.atan(c.height / 2 / c.fy) * 180) / Math.PI };
    e.seek(time);
    await e.settled();
    const picture = await createImageBitmap(await e.screenshot());
    const draw = new OffscreenCanvas(picture.width, picture.height).getContext('2d');
    draw.drawImage(picture, 0, 0);
    return [...draw.getImageData(0, 0, picture.width, picture.height).data];
  }, time);
}

for (const [name, [packages, script, modules]] of Object.entries(ENGINES)) {
  const missing = [...packages, 'esbuild'].filter((p) => !there(p));
  const skip = !browser ? 'needs a browser' : missing.length ? `needs ${missing.join(', ')}` : false;
  if (skip && process.env.REQUIRE_ENGINES === '1') throw new Error(`${name} ${skip}`);
  test(`${name} matches the player when seeking and playing, and releases its memory`, { skip }, async (t) => {
    const body = `<canvas width="${WIDTH}" height="${HEIGHT}" style="display:block"></canvas><script type="module">${script}</script>`;
    const { page: p, errors } = await page(body, await modules(), (done) => t.after(done));
    await p.waitForFunction(() => window.shown, null, { timeout: PATIENCE }).catch((e) => assert.fail(`${e.message} ${errors}`));
    // Backwards: rows and orders that are left from a later time would show.
    const images = [];
    for (const at of [TIMES[1], TIMES[0]]) images.push([at, await p.evaluate((time) => window.seek(time), at)]);
    const { time, image } = await p.evaluate((until) => window.play(until), TIMES[0] + 0.05);
    images.push([time, image]);
    const truncated = await p.evaluate(async () => {
      const { Frames } = await import('/splat4d/frames.js');
      const told = [],
        frames = new Frames('/cut.s4d', { onerror: (error) => told.push(error.message) });
      return frames.load(5.9).then(() => null, (error) => `${error.message} (${told.length} reported)`);
    });
    assert.ok(truncated, 'a truncated file is an error');
    t.diagnostic(`a truncated file: ${truncated}`);
    const { left, freed } = await p.evaluate(() => window.dispose());
    t.diagnostic(`disposed: ${freed} freed`);
    assert.equal(left, 0, 'nothing stays in the scene');
    assert.ok(freed > 0, 'textures are given back');
    assert.deepEqual(errors, []);
    const element = await (player ??= start());
    for (const [time, have] of images) {
      const want = await shot(element, time);
      assert.equal(have.length, want.length, 'the player has the same size');
      const db = psnr(have, want);
      t.diagnostic(`at ${time.toFixed(3)} s: ${db.toFixed(1)} dB`);
      assert.ok(db >= ALIKE, `${db} dB at ${time} s`);
    }
  });
}

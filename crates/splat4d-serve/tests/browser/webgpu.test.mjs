// The WebGPU backend in a real headless Chromium (SwiftShader) against the f64 oracle.

import assert from 'node:assert/strict';
import { after, before, test } from 'node:test';
import http from 'node:http';
import { readFile } from 'node:fs/promises';
import { createRequire } from 'node:module';
import * as oracle from './oracle.mjs';
import * as toy from './toy.mjs';

const { chromium } = createRequire(process.env.PLAYWRIGHT ?? import.meta.url)('playwright-core');
/// Least agreement of a picture with the oracle's, dB: 8-bit rounding alone gives 59.
const LEAST_DB = 42;
let server, browser, tab;
const complaints = [];

before(async () => {
  const types = { js: 'text/javascript', mjs: 'text/javascript', html: 'text/html' };
  const root = new URL('../../', import.meta.url);
  server = http.createServer(async (request, response) => {
    const path = new URL(request.url, 'http://x').pathname;
    try {
      const body = path === '/' ? '<!doctype html><link rel="icon" href="data:,"><canvas id="c"></canvas>' : await readFile(new URL('.' + path, root));
      response.writeHead(200, { 'content-type': types[path.split('.').pop()] ?? 'text/html' }).end(body);
    } catch {
      response.writeHead(404).end();
    }
  });
  await new Promise((done) => server.listen(0, '127.0.0.1', done));
  browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium',
    args: ['--no-sandbox', '--disable-background-networking', '--disable-component-update', '--disable-sync',
      '--no-first-run', '--enable-unsafe-webgpu', '--use-webgpu-adapter=swiftshader',
      // Without these three a WebGPU canvas takes the GPU process down where there is no graphics card.
      '--enable-features=Vulkan', '--use-vulkan=swiftshader', '--use-angle=swiftshader'],
  });
  tab = await browser.newPage();
  tab.on('console', (m) => { if (['error', 'warning'].includes(m.type())) complaints.push(m.text()); });
  tab.on('pageerror', (e) => complaints.push(String(e)));
  await tab.goto(`http://127.0.0.1:${server.address().port}/`);
  await tab.evaluate(async () => {
    Object.assign(globalThis, await import('/player/webgpu.js'), await import('/player/shaders.js'));
    globalThis.toy = await import('/tests/browser/toy.mjs');
    // A backend over a fresh canvas, with a scene: pages and palettes by the arguments of toy.mjs.
    globalThis.scene = async ({ pages, palettes = [], clip = [0, 1] }, width, height) => {
      globalThis.backend?.destroy();
      const canvas = document.createElement('canvas');
      globalThis.backend = await WebGPUBackend.create(canvas, { onlost: (e) => { globalThis.lost = String(e); } });
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

after(async () => {
  await browser?.close();
  server?.close();
});

/// The oracle's twin of `scene` in the page.
function build({ pages, palettes = [] }) {
  const known = new Map(palettes.map((p) => [p[0], toy.palette(...p)]));
  return pages.map((p) => {
    const made = toy.page(...p);
    return { ...made, palette: known.get(made.entry.palette) };
  });
}

const SCENE = {
  palettes: [[7, 3, 40], [8, 1, 5, 3]],
  pages: [
    [0, 1500, { from: 0, to: 1.04, palette: 7, entries: 40 }],
    [1, 700, { from: 0, to: 0.5, palette: 8, entries: 5, tier: 0 }],
    [2, 300, { from: 0.5, to: 1.04, logScale: [-6, -1.5] }],
  ],
};
const VIEW = [[1.5, 0.8, 2.4], 200, 150, 190];
const WHAT = { view: VIEW, background: [0.2, 0.5, 0.9], depthRange: [1.5, 4.5], flowScale: 60 };

for (const [channel, time] of [['color', 0.3], ['color', 0.7], ['color', 1], ['alpha', 0.3], ['depth', 0.7], ['flow', 0.3]]) {
  test(`${channel} at ${time} s is the oracle's`, async () => {
    const what = { ...WHAT, channel, time };
    const got = await tab.evaluate(async ([s, w]) => {
      await scene(s, w.view[1], w.view[2]);
      return picture(w);
    }, [SCENE, what]);
    const truth = oracle.render(build(SCENE), { ...what, view: toy.view(...VIEW) });
    const db = oracle.psnr(got, truth.data);
    console.log(`    ${channel} ${time}: ${db.toFixed(1)} dB`);
    assert.ok(db >= LEAST_DB, `${db} dB`);
    assert.ok(new Set(truth.data).size > 20, 'the oracle drew something');
  });
}

test('nothing complained', () => assert.deepEqual(complaints, []));

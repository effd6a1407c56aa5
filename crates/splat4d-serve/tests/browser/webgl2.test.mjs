// The WebGL2 backend in a real browser against the f64 reference: every channel, several times, streamed over ranges.

import assert from 'node:assert/strict';
import test from 'node:test';
import { launch, open } from './browser.mjs';
import { psnr, render } from './reference.mjs';
import { sample } from './sample.mjs';
import { serve } from './server.mjs';

/// The bound for pictures against the CPU renderer, dB, and what is reached here and must not get lost.
const BOUND = 35,
  REACHED = 55;

const browser = await launch();
test.after(() => browser?.close());

/// A camera at (x, y, z) that looks along a direction turned by `yaw` about y.
function view(x, y, z, yaw, width = 160, height = 120, f = 150) {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)],
    rows = [
      [c, 0, -s],
      [0, 1, 0],
      [s, 0, c],
    ];
  const cameraFromWorld = rows.flatMap((r) => [...r, -(r[0] * x + r[1] * y + r[2] * z)]);
  return { cameraFromWorld, fx: f, fy: f * 1.02, cx: width / 2 + 3.3, cy: height / 2 - 2.7, width, height };
}

/// Loads the sample into a backend on the page, as `globalThis.shown`.
async function show(page, url, name) {
  await page.evaluate(
    async ([url, name]) => {
      const { SceneFile } = await import('/player/scene-file.js');
      const { Stream } = await import('/player/stream.js');
      const module = await import(`/player/${name}.js`);
      const canvas = document.createElement('canvas');
      document.body.append(canvas);
      const errors = [];
      const backend = await Object.values(module)
        .find((c) => c?.create)
        .create(canvas, { onlost: (e) => errors.push(e.message) });
      const file = await SceneFile.open(url);
      backend.setScene(file.meta);
      const stream = new Stream(file, backend, { onerror: (e) => errors.push(e.message) });
      globalThis.shown = { file, backend, stream, errors };
    },
    [url, name],
  );
}

/// A picture from the page: RGBA bytes.
async function picture(page, params) {
  const text = await page.evaluate(async (p) => {
    const { backend, stream } = globalThis.shown;
    p.view.cameraFromWorld = Float64Array.from(p.view.cameraFromWorld);
    backend.resize(p.view.width, p.view.height);
    await stream.settled(p.time);
    backend.draw(p);
    await backend.settled();
    const { data } = await backend.readPixels();
    let s = '';
    for (let i = 0; i < data.length; i += 8192) s += String.fromCharCode(...data.subarray(i, i + 8192));
    return btoa(s);
  }, params);
  return Buffer.from(text, 'base64');
}

const looks = [
  { time: 2, view: view(0, 0, 0, 0) },
  { time: 3.4, view: view(0.8, -0.3, 0.4, 0.3), background: [0.9, 0.5, 0.1] },
  { time: 4.999, view: view(0, 0, 3, 0) },
  { time: 6, view: view(-3, 0.2, 4, 1.5) },
  { time: 3.4, view: view(0, 0, 0, 0), channel: 'alpha' },
  { time: 3.4, view: view(0, 0, 0, 0), channel: 'depth', depthRange: [2, 6] },
  { time: 3.4, view: view(0, 0, 0, 0), channel: 'flow', flowScale: 12 },
];

for (const backend of ['webgl2']) {
  test(`${backend} draws what the reference draws`, { skip: !browser }, async () => {
    const { bytes, truth } = sample(),
      server = await serve({ files: { 'a.html': '<!doctype html><body>', 'a.splat4d': bytes } });
    const { page, errors } = await open(browser, server.url + 'a.html');
    try {
      await show(page, '/a.splat4d', backend);
      for (const look of looks) {
        const bare = render([], look.time, look.view, look);
        const [here, want] = [await picture(page, look), render(truth, look.time, look.view, look)];
        const db = psnr(here, want);
        console.log(`${backend} ${look.channel ?? 'color'} at ${look.time}: ${db.toFixed(1)} dB`);
        assert.ok(psnr(want, bare) < 28, 'there is something to see');
        assert.ok(db >= BOUND, `${db} dB`);
        if (!look.channel) assert.ok(db >= REACHED, `${db} dB: it was better once`);
      }
      assert.deepEqual([errors, await page.evaluate(() => globalThis.shown.errors)], [[], []]);
    } finally {
      await page.close();
      await server.close();
    }
  });

  test(
    `${backend} survives pages that come and go, sizes that change and its own end`,
    { skip: !browser },
    async () => {
      const { bytes, truth } = sample({ seed: 9 }),
        server = await serve({ files: { 'a.html': '<!doctype html><body>', 'a.splat4d': bytes } });
      const { page, errors } = await open(browser, server.url + 'a.html');
      try {
        await show(page, '/a.splat4d', backend);
        await page.evaluate(() => {
          // The least budget that holds any moment: every seek drops pages and lends their rows anew.
          const { file, backend } = globalThis.shown;
          const old = globalThis.shown.stream;
          old.destroy();
          backend.setScene(file.meta);
          globalThis.shown.stream = new old.constructor(file, backend, {
            budget: 32 * (700 + 1025 + 511),
            onerror: (e) => globalThis.shown.errors.push(e.message),
          });
        });
        for (let i = 0; i < 12; i++) {
          const look = { time: 2.1 + ((i * 1.7) % 3.9), view: view(0.1 * i, 0, 0, 0, 96 + (i % 3) * 16, 64) };
          const db = psnr(await picture(page, look), render(truth, look.time, look.view, {}));
          assert.ok(db >= REACHED - 3, `look ${i}: ${db} dB`);
        }
        const stats = await page.evaluate(() => ({ ...globalThis.shown.backend.stats }));
        assert.ok(
          stats.resident <= 700 + 1025 + 511 && stats.drawn > 0 && stats.drawn <= stats.active,
          JSON.stringify(stats),
        );
        await page.evaluate(() => (globalThis.shown.stream.destroy(), globalThis.shown.backend.destroy()));
        assert.deepEqual(errors, []);
      } finally {
        await page.close();
        await server.close();
      }
    },
  );
}

// Both backends in a real browser against the f64 reference: every channel, several times, streamed over ranges; on
// machines that offer less; and when the graphics device goes away.

import assert from 'node:assert/strict';
import { existsSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { pathToFileURL } from 'node:url';
import { launch, open } from './browser.mjs';
import { psnr, render } from './reference.mjs';
import { sample } from './sample.mjs';
import { PLAYER, serve } from './server.mjs';

/// The bound for images against the CPU renderer, dB, and what is reached here and must not get lost.
const BOUND = 35;
const REACHED = 55;
/// With sums of 8 bits: each of some 30 splats over one another rounds once.
const EIGHT_BITS = 48;

const browser = await launch();
test.after(() => browser?.close());

/// A camera at (x, y, z) that looks along +z turned by `yaw` about y.
function view(x, y, z, yaw, width = 160, height = 120, f = 150) {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  const rows = [c, 0, -s, 0, 1, 0, s, 0, c];
  const cameraFromWorld = [0, 3, 6].flatMap((i) => {
    const r = rows.slice(i, i + 3);
    return [...r, -(r[0] * x + r[1] * y + r[2] * z)];
  });
  return { cameraFromWorld, fx: f, fy: f * 1.02, cx: width / 2 + 3.3, cy: height / 2 - 2.7, width, height };
}

/// Runs `body` on a page that shows `made` (of sample.mjs) with a backend. `before` runs in the page before anything.
async function shown(backend, made, body, { before, policy } = {}) {
  const rule = policy ? `<meta http-equiv="Content-Security-Policy" content="${policy}">` : '';
  const html = `<!doctype html>${rule}<body>`;
  const server = await serve({ files: { 'a.html': html, 'a.s4d': made.bytes } });
  const { page, errors } = await open(browser, server.url + 'a.html');
  try {
    if (before) await page.evaluate(before);
    await page.evaluate(async (name) => {
      const { SceneFile } = await import('/player/scene-file.js');
      const { Stream } = await import('/player/stream.js');
      const module = await import(`/player/${name}.js`);
      const canvas = document.body.appendChild(document.createElement('canvas'));
      const [errors, lost] = [[], []];
      const { create } = Object.values(module).find((c) => c?.create);
      const backend = await create(canvas, { onlost: (e) => lost.push(e?.message ?? 'lost') });
      const file = await SceneFile.open('/a.s4d');
      backend.setScene(file.meta);
      const restart = (options) => {
        globalThis.shown.stream?.destroy();
        backend.setScene(file.meta);
        globalThis.shown.stream = new Stream(file, backend, { onerror: (e) => errors.push(e.message), ...options });
      };
      globalThis.shown = { canvas, file, backend, errors, lost, restart };
      restart({});
    }, backend);
    await body(page);
    // The browser itself states in the console what a policy forbids.
    const wrong = errors.filter((e) => !(policy && e.includes('Content Security Policy')));
    assert.deepEqual([wrong, await page.evaluate(() => globalThis.shown.errors)], [[], []]);
  } finally {
    await page.close();
    await server.close();
  }
}

/// An image from the page: RGBA bytes. `canvas`: as the browser shows it, else as `readPixels` gives it.
async function picture(page, params, { canvas = false } = {}) {
  let text = await page.evaluate(async (p) => {
    const { backend, stream } = globalThis.shown;
    p.view.cameraFromWorld = Float64Array.from(p.view.cameraFromWorld);
    backend.resize(p.view.width, p.view.height);
    await stream.settled(p.time);
    backend.draw(p);
    await backend.settled();
    globalThis.pack = (data) => {
      let s = '';
      for (let i = 0; i < data.length; i += 8192) s += String.fromCharCode(...data.subarray(i, i + 8192));
      return btoa(s);
    };
    return globalThis.pack((await backend.readPixels()).data);
  }, params);
  if (canvas) {
    const png = await page.locator('canvas').screenshot();
    text = await page.evaluate(async (base64) => {
      const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
      const picture = await createImageBitmap(new Blob([bytes], { type: 'image/png' }));
      const flat = new OffscreenCanvas(picture.width, picture.height).getContext('2d');
      flat.drawImage(picture, 0, 0);
      return globalThis.pack(flat.getImageData(0, 0, picture.width, picture.height).data);
    }, png.toString('base64'));
  }
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

/// Compares a look with the reference; returns dB.
async function compare(page, made, look, options) {
  const want = render(made.truth, look.time, look.view, look);
  assert.ok(psnr(want, render([], look.time, look.view, look)) < 28, 'there is something to see');
  return psnr(await picture(page, look, options), want);
}

for (const backend of ['webgl2', 'webgpu']) {
  const skip = !browser || !existsSync(`${PLAYER}${backend}.js`);

  test(`${backend} renders like the reference`, { skip }, () => {
    const made = sample();
    return shown(backend, made, async (page) => {
      for (const look of looks) {
        const db = await compare(page, made, look);
        console.log(`${backend} ${look.channel ?? 'color'} at ${look.time}: ${db.toFixed(1)} dB`);
        assert.ok(db >= (look.channel ? BOUND : REACHED), `${look.channel ?? 'color'} at ${look.time}: ${db} dB`);
      }
      assert.ok(page.workers().length >= 1, 'decoding and sorting have threads of their own');
      const db = await compare(page, made, looks[1], { canvas: true });
      assert.ok(db >= REACHED, `on the canvas: ${db} dB`);
    });
  });

  test(`${backend} renders only the Gaussians that key masks admit`, { skip }, () => {
    const made = sample({ masks: 0.5 }),
      bare = sample({ masks: 0.5, patch: (sections) => sections.filter((s) => s.kind !== 'MASK') });
    return shown(backend, made, async (page) => {
      // Between two key times and on one, forwards and backwards, before and behind a single one.
      for (const time of [2, 2.2, 2.5, 2.3, 3, 5.6, 6, 3.74, 3.5]) {
        const look = { time, view: view(0.2, -0.1, 0.3, 0.1) };
        const db = await compare(page, made, look);
        console.log(`${backend} with masks at ${time}: ${db.toFixed(1)} dB`);
        assert.ok(db >= REACHED, `at ${time}: ${db} dB`);
        const all = render(bare.truth.map((g) => ({ ...g, admitted: null })), time, look.view, look);
        const some = render(made.truth, time, look.view, look);
        assert.ok(psnr(all, some) < BOUND, `at ${time} the masks are to be seen: ${psnr(all, some)} dB`);
      }
      const { active, drawn } = await page.evaluate(() => ({ ...globalThis.shown.backend.stats }));
      assert.equal(active, made.truth.filter((g) => g.span[0] <= 3.5 && 3.5 < g.span[1] && g.admitted(3.5)).length);
      assert.ok(drawn > 0 && drawn <= active, `${drawn} of ${active}`);
    });
  });

  test(`${backend} renders a page without its mask until the mask is loaded`, { skip }, () => {
    const made = sample({ masks: 0.5 }),
      unmasked = { truth: made.truth.map((g) => ({ ...g, admitted: null })) };
    return shown(backend, made, async (page) => {
      const look = { time: 3.2, view: view(0, 0, 0, 0) };
      await page.evaluate(() => {
        const { file, restart } = globalThis.shown,
          mask = file.mask.bind(file);
        const held = new Promise((go) => (globalThis.arrive = go));
        file.mask = (...args) => held.then(() => mask(...args));
        restart({});
      });
      await page.evaluate(async (time) => {
        const { stream } = globalThis.shown;
        stream.update(time);
        while (stream.ready(time) < 1) await new Promise((done) => setTimeout(done, 10));
        // The pages are there; what settles is only the masks.
        stream.settled = () => {};
      }, look.time);
      assert.ok((await compare(page, unmasked, look)) >= REACHED, 'all are drawn');
      await page.evaluate(async (time) => {
        const { stream } = globalThis.shown;
        delete stream.settled;
        globalThis.arrive();
        await stream.settled(time);
      }, look.time);
      assert.ok((await compare(page, made, look)) >= REACHED, 'the masks came');
      // Reused places have lost their masks: every page is dropped and loaded again without masks.
      await page.evaluate(() => {
        const { file, restart } = globalThis.shown;
        for (const entry of file.pages) entry.mask = -1;
        restart({});
      });
      assert.ok((await compare(page, unmasked, look)) >= REACHED, 'all are drawn again');
    });
  });

  test(`${backend} survives page changes, resizes and disposal`, { skip }, () => {
    const made = sample({ seed: 9, masks: 0.3 });
    // What the fullest time needs, and no page more: every seek drops pages and lends their rows again.
    const most = 700 + 1025 + 511;
    return shown(backend, made, async (page) => {
      await page.evaluate((most) => {
        const { file, restart } = globalThis.shown;
        const masks = file.pages.reduce((n, p) => n + ([700, 1025, 511].includes(p.count) ? p.maskBytes : 0), 0);
        restart({ budget: 32 * most + masks });
      }, most);
      for (let i = 0; i < 12; i++) {
        const look = { time: 2.1 + ((i * 1.7) % 3.9), view: view(0.1 * i, 0, 0, 0, 96 + (i % 3) * 16, 64) };
        const db = await compare(page, made, look);
        assert.ok(db >= REACHED - 3, `look ${i}: ${db} dB`);
      }
      const stats = await page.evaluate(() => ({ ...globalThis.shown.backend.stats }));
      const { resident, active, drawn } = stats;
      assert.ok(resident <= most && drawn > 0 && drawn <= active, JSON.stringify(stats));
      await page.evaluate(() => {
        globalThis.shown.stream.destroy();
        globalThis.shown.backend.destroy();
      });
    });
  });
}

const skip = !browser;

test('webgl2 without float targets, and without workers, renders the same', { skip }, async () => {
  const made = sample({ masks: 0.5 });
  const poor = [
    ['half floats', REACHED, { before: () => hide('EXT_color_buffer_float') }],
    ['bytes', EIGHT_BITS, { before: () => hide('EXT_color_buffer_float', 'EXT_color_buffer_half_float') }],
    ['no workers', REACHED, { before: () => void delete globalThis.Worker }],
    ['workers forbidden', REACHED, { before: () => {}, policy: "worker-src 'none'" }],
  ];
  for (const [name, bound, { before, policy }] of poor) {
    const text = `(() => {
      const hide = (...names) => {
        const get = WebGL2RenderingContext.prototype.getExtension;
        WebGL2RenderingContext.prototype.getExtension = function (n) {
          return names.includes(n) ? null : get.call(this, n);
        };
      };
      (${before})();
    })()`;
    await shown(
      'webgl2',
      made,
      async (page) => {
        const db = await compare(page, made, looks[1]);
        console.log(`webgl2 with ${name}: ${db.toFixed(1)} dB`);
        assert.ok(db >= bound, `${name}: ${db} dB`);
      },
      { before: text, policy },
    );
  }
});

test('webgl2 reports a lost device and stops waiting', { skip }, () =>
  shown('webgl2', sample(), async (page) => {
    await picture(page, looks[0]);
    await page.evaluate(async (look) => {
      const { backend } = globalThis.shown;
      const lose = backend.gl.getExtension('WEBGL_lose_context');
      backend.draw({ ...look, time: 3 });
      lose.loseContext();
      await backend.settled();
      await new Promise((done) => setTimeout(done, 100));
      backend.draw(look);
      await backend.settled();
      await backend.readPixels();
      backend.destroy();
    }, looks[0]);
    const lost = await page.evaluate(() => globalThis.shown.lost);
    assert.equal(lost.length, 1);
    assert.match(lost[0], /device/);
  }),
);

test('workers start from blobs on a page opened from a disk', { skip }, async () => {
  const folder = mkdtempSync(path.join(tmpdir(), 'splat4d-')),
    file = path.join(folder, 'a.html');
  try {
    writeFileSync(file, '<!doctype html><body>');
    const { page } = await open(browser, pathToFileURL(file).href);
    for (const [name, message] of [
      ['sort.worker.js', { sort: { time: 0, views: [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]], near: 0 } }],
      ['decode.worker.js', { ticket: 1, job: { stored: new Uint8Array(0), crc: 0, codec: 0, kind: 'POST' } }],
    ]) {
      const text = readFileSync(PLAYER + name, 'utf8');
      const answer = await page.evaluate(
        ([text, message]) =>
          new Promise((done) => {
            const made = new Worker(URL.createObjectURL(new Blob([text], { type: 'text/javascript' })));
            made.onmessage = ({ data }) => data.ready || done(Object.keys(data));
            made.onerror = () => done('it did not start');
            if (message.job) message.job.stored = new Uint8Array(0);
            made.postMessage(message);
          }),
        [text, JSON.parse(JSON.stringify(message))],
      );
      assert.ok(answer.includes('orders') || answer.includes('result'), `${name}: ${answer}`);
    }
    await page.close();
  } finally {
    rmSync(folder, { recursive: true });
  }
});

// The first seconds on a slow line: the poster stays until there is an image that is like it, and the clock starts only
// then. And a file that was cut short.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { launch, open } from './browser.mjs';
import { serve } from './server.mjs';

const KNIGHT = readFileSync(fileURLToPath(new URL('../../../../examples/knight.s4d', import.meta.url)));
/// A slow phone's line: bytes per second, ms.
const LINE = { offline: false, latency: 150, downloadThroughput: 200_000, uploadThroughput: 100_000 };
/// The first image against the settled one of the same time, dB: all of it, and where something moves.
const WHOLE = 27,
  MOVING = 22;

const browser = await launch();
const options = { skip: browser ? false : 'needs a browser' };
test.after(() => browser?.close());

const HTML = `<!doctype html><link rel="icon" href="data:,"><splat-4d src="/knight.s4d" autoplay backend="webgl2" resolution="1"
  style="display:block;width:160px;height:120px;min-height:0"></splat-4d><script type="module" src="/player/element.js"></script>`;

async function opened(bytes, t) {
  const server = await serve({ files: { 'a.html': HTML, 'empty.html': HTML.slice(0, 15), 'knight.s4d': bytes } });
  const { page, errors } = await open(browser, `${server.url}empty.html`);
  t.after(() => Promise.all([page.close(), server.close()]));
  return { page, errors, url: `${server.url}a.html` };
}

test('on a slow connection the poster stays until the scene matches it', options, async (t) => {
  const { page, errors, url } = await opened(KNIGHT, t);
  const line = await page.context().newCDPSession(page);
  await line.send('Network.enable');
  // The player itself comes at once: this is about the scene.
  await page.addInitScript(() => {
    globalThis.log = [];
    addEventListener('DOMContentLoaded', () => {
      const e = document.querySelector('splat-4d');
      const copy = (canvas) => {
        const { width, height } = canvas,
          draw = new OffscreenCanvas(width, height).getContext('2d');
        draw.drawImage(canvas, 0, 0);
        return [...draw.getImageData(0, 0, width, height).data];
      };
      const poster = () => e.shadowRoot.querySelector('.poster').classList.contains('on');
      e.addEventListener('timeupdate', ({ detail }) => globalThis.log.push([detail.time, e.player.ready(detail.time), poster()]));
      e.addEventListener('timeupdate', ({ detail }) => {
        globalThis.first ??= { time: detail.time, data: copy(e.player.canvas) };
      });
      globalThis.seek = (time) =>
        new Promise((done) => {
          const see = ({ detail }) => {
            if (Math.abs(detail.time - time) > 1e-6) return;
            e.removeEventListener('timeupdate', see);
            done(copy(e.player.canvas));
          };
          e.addEventListener('timeupdate', see);
          e.seek(time);
        });
    });
  });
  await page.route('**/knight.s4d', async (route) => {
    await line.send('Network.emulateNetworkConditions', LINE);
    await route.continue();
  });
  await page.goto(url);
  const poster = () => document.querySelector('splat-4d').shadowRoot?.querySelector('.poster.on')?.naturalWidth > 0;
  await page.waitForFunction(poster, null, { timeout: 60000 });
  const early = await page.evaluate(() => ((e) => [e.player.state, e.player.clock, globalThis.log.length])(document.querySelector('splat-4d')));
  assert.deepEqual(early, ['loading', 0, 0], 'the poster comes first, and the clock stands');
  await page.waitForFunction(() => document.querySelector('splat-4d').statistics.firstFrame > 0, null, { timeout: 60000 });
  const [first, log] = await page.evaluate(() => [globalThis.first, globalThis.log]);
  assert.equal(first.time, 0, 'the clock starts with the first image');
  assert.ok(log[0][2], 'which takes the place of the poster');
  await page.evaluate(() => document.querySelector('splat-4d').pause());
  const other = await page.evaluate(() => globalThis.seek(0.5));
  const settled = await page.evaluate(() => globalThis.seek(0));
  const decibel = (moving) => {
    let [sum, count] = [0, 0];
    for (let i = 0; i < settled.length; i += 4) {
      const change = [0, 1, 2].reduce((m, k) => Math.max(m, Math.abs(settled[i + k] - other[i + k])), 0);
      if (moving && change < 24) continue;
      for (let k = 0; k < 3; k++, count++) sum += (settled[i + k] - first.data[i + k]) ** 2;
    }
    assert.ok(count > 300, `${count}`);
    return 10 * Math.log10((255 * 255 * count) / (sum || 1));
  };
  t.diagnostic(`first image ${decibel(false).toFixed(1)} dB, where something moves ${decibel(true).toFixed(1)} dB`);
  assert.ok(decibel(false) >= WHOLE && decibel(true) >= MOVING, `${decibel(false)} and ${decibel(true)} dB`);
  assert.deepEqual(errors, []);
});

test('a truncated file plays what it holds, and reports it', options, async (t) => {
  const { page, url } = await opened(KNIGHT.subarray(0, 300_000), t);
  await page.addInitScript(() => {
    addEventListener('DOMContentLoaded', () =>
      document.querySelector('splat-4d').addEventListener('error', ({ detail }) => (globalThis.said = detail)),
    );
  });
  await page.goto(url);
  await page.waitForFunction(() => document.querySelector('splat-4d').statistics?.firstFrame > 0, null, { timeout: 60000 });
  const { what, remedy } = await page.evaluate(() => ({ what: globalThis.said?.what, remedy: globalThis.said?.remedy }));
  assert.match(what, /truncated: 300000 of 766421 bytes/);
  assert.match(remedy, /again/);
});

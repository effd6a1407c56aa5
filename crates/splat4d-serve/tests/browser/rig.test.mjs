// Cameras of a capture in the scene, their images next to the render, and the buttons of a run that is learning. Files
// and images are stand-ins (mock/).

import assert from 'node:assert/strict';
import { after, before, test } from 'node:test';
import { launch } from './browser.mjs';
import { Site } from './ui-harness.mjs';

const TOKEN = '0123456789abcdef';
const browser = await launch();
const options = { skip: browser ? false : 'no browser', timeout: 60000 };
let site;

before(async () => { site = await new Site().start(); });
after(async () => {
  await browser?.close();
  await site.stop();
});

/** Cameras as the program lists them: they look along -z from 4 units away. */
const cameras = ['left', 'right'].map((name, k) => ({
  name, width: 800, height: 600, fx: 900, fy: 900, cx: 400, cy: 300, frames: 25, held: k === 1, offset: k ? 0.0123 : null,
  world_from_camera: [1, 0, 0, 2 * k - 1, 0, -1, 0, 1, 0, 0, -1, 4],
}));

async function open(config, path = '') {
  site.config = { title: 'capture', scene: 'scene.s4d', live: false, autoplay: false, ...config };
  site.photos.length = site.controlled.length = 0;
  const page = await browser.newPage({ viewport: { width: 1000, height: 800 } });
  const errors = [];
  page.on('pageerror', e => errors.push(e.stack));
  await page.goto(site.url + path);
  await page.waitForFunction(() => document.querySelector('splat-4d')?.player?.state === 'ready');
  return { page, errors, ask: (f, arg) => page.$eval('splat-4d', f, arg) };
}

test('a capture is shown by frusta with images, and a camera by its image next to the render', options, async () => {
  const { page, errors, ask } = await open({ cameras, photos: true, frusta: true });
  await page.waitForFunction(() => document.querySelector('splat-4d').face.rig?.places?.length === 2);
  assert.deepEqual(await ask(e => e.player.meta.cameras.map(c => c.name)), ['left', 'right'], 'the list of the program');
  await page.waitForFunction(() => document.querySelector('splat-4d').face.rig.shown);
  // Both frusta fetch a small image of the time that is shown.
  await page.waitForTimeout(500);
  assert.deepEqual(site.photos.slice(0, 2).map(p => [p.view, p.t]), [['0', '1'], ['1', '1']]);
  // A click on a camera looks through it.
  const [x, y] = await ask(e => e.face.rig.places.find(p => p.i === 1).at);
  await page.mouse.click(x, y);
  await page.waitForFunction(() => document.querySelector('splat-4d').player.viewed === 1);
  await page.keyboard.press('z');
  const caption = page.locator('splat-4d figcaption');
  await caption.getByText('right').waitFor();
  assert.equal(await caption.innerText(), 'right · 0.000 s · clock +12.3 ms · held out');
  const [stage, photo] = await ask(e => ['.stage', '.photo'].map(s => e.shadowRoot.querySelector(s).getBoundingClientRect().toJSON()));
  assert.deepEqual([stage.width, photo.width, photo.left], [500, 500, 500], 'side by side');
  await ask(e => e.seek(2));
  await caption.getByText('1.000 s').waitFor();
  await page.keyboard.press('z');
  await page.keyboard.press('v');
  await page.waitForFunction(() => !document.querySelector('splat-4d').face.rig.shown);
  assert.equal(await ask(e => e.shadowRoot.querySelector('.stage').clientWidth), 1000, 'the render has the page again');
  assert.deepEqual(errors, []);
  await page.close();
});

test('without images of a capture the panel offers frusta alone', options, async () => {
  const { page, errors, ask } = await open({});
  await page.keyboard.press('z');
  assert.ok(!await ask(e => e.face.rig), 'there is nothing to compare with');
  await page.keyboard.press('v');
  await page.waitForFunction(() => document.querySelector('splat-4d').face.rig?.places?.length > 0);
  await page.getByRole('button', { name: 'Cameras and paths' }).click();
  assert.ok(await page.getByLabel('Show cameras in the scene (V)').isChecked());
  assert.ok(await page.getByLabel('Image next to the render (Z)').isHidden());
  assert.deepEqual([site.photos, errors], [[], []]);
  await page.close();
});

test('a run is paused, continued and stopped from its page, with the token and without it not', options, async () => {
  site.history = [];
  site.pages['/scene.s4d'] = 'the bytes of a scene';
  const step = i => site.say({ kind: 'step', iteration: i, iterations: 500, psnr: 15 + i, loss: 0.3 / i, held_out: 14 + i, gaussians: 9000, seconds_left: 9 });
  step(1);
  step(2);
  site.say({ kind: 'snapshot', version: 1 });
  const config = { live: true, control: true, cameras, photos: true };
  const { page, errors, ask } = await open(config, `#control=${TOKEN}`);
  assert.equal(await page.evaluate(() => location.hash), '', 'the token leaves the address');
  const card = page.getByRole('region', { name: 'Training' });
  await card.getByText('16.00').waitFor();
  assert.match(await card.innerText(), /held out \(dotted\)[^]*16\.00\s*dB, held out/);
  await card.getByRole('button', { name: 'Pause' }).click();
  await card.getByText('Pausing').waitFor();
  site.say({ kind: 'control', state: 'paused' });
  await card.getByText('Paused').waitFor();
  await card.getByRole('button', { name: 'Continue' }).click();
  await card.getByText('Training', { exact: true }).waitFor();
  await card.getByRole('button', { name: 'Compare' }).click();
  await page.locator('splat-4d figcaption').getByText('left').waitFor();
  await card.getByRole('button', { name: 'Stop' }).click();
  site.say({ kind: 'control', state: 'stopped', iteration: 2, resume: 'splat4d train --resume runs/a' });
  await card.getByText('splat4d train --resume runs/a').waitFor();
  assert.ok(await card.getByRole('button', { name: 'Stop' }).isHidden());
  assert.deepEqual(site.controlled, ['pause', 'continue', 'stop'].map(what => ({ do: what, token: TOKEN })));
  assert.deepEqual(errors, []);
  await page.close();
  // A user who was given the address without its token may look.
  site.history = [];
  step(3);
  site.say({ kind: 'snapshot', version: 1 });
  const other = await open(config);
  await other.page.getByRole('region', { name: 'Training' }).getByText('18.00').waitFor();
  assert.equal(await other.page.getByRole('button', { name: 'Pause' }).count(), 0);
  await other.page.close();
});

// Manual alignment as people do it: the program serves images of four cameras far apart, Chromium clicks points with mouse
// and fingers, sees poses and distances, marks an event, floor and length, and finishes. SPLAT4D names the program.

import assert from 'node:assert/strict';
import { spawn } from 'node:child_process';
import { cpSync, existsSync, mkdirSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { launch } from './browser.mjs';

const BUNDLED = fileURLToPath(new URL('../../../../examples/knight', import.meta.url));
/// Cameras 45 to 63 degrees apart.
const CAMERAS = ['cam00', 'cam07', 'cam12', 'cam19'];
const PLACES = [[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1], [-0.5, 1.5, 0.2], [0.6, 2, -0.3], [0.1, 1, 0.7], [-0.8, 0.8, -0.6]];
const PROGRAM = process.env.SPLAT4D;
const browser = PROGRAM && existsSync(PROGRAM) ? await launch() : null;
const PATIENCE = 120000;
const options = { skip: browser ? false : 'needs the program (SPLAT4D) and a browser', timeout: 3 * PATIENCE };
const work = mkdtempSync(path.join(tmpdir(), 'splat4d-assist-'));
const take = path.join(work, 'take');
const programs = [];
test.after(async () => {
  programs.forEach((p) => p.kill('SIGINT'));
  await browser?.close();
  rmSync(work, { recursive: true });
});

/// Starts `import --assist`: {url, ended: a promise of its exit code, text(): what it printed}.
function assist() {
  const films = path.join(work, 'films');
  for (const name of CAMERAS) {
    mkdirSync(path.join(films, name), { recursive: true });
    for (let k = 0; k < 4; k++) {
      const file = `${String(k).padStart(4, '0')}.jpg`;
      cpSync(path.join(BUNDLED, 'images', name, file), path.join(films, name, file));
    }
  }
  const args = ['import', films, '-o', take, '--assist', '--no-doctor', '--no-open', '--json', '--port', '0'];
  const child = spawn(PROGRAM, args, { stdio: ['ignore', 'pipe', 'inherit'] });
  programs.push(child);
  let text = '';
  const ended = new Promise((done) => child.on('exit', done));
  return new Promise((found, failed) => {
    child.stdout.on('data', (data) => {
      text += data;
      const line = text.split('\n').find((l) => l.includes('"serving"'));
      if (line) found({ url: JSON.parse(line).url, ended, text: () => text });
    });
    child.on('exit', (code) => failed(new Error(`import ended with ${code}`)));
  });
}

const capture = JSON.parse(readFileSync(path.join(BUNDLED, 'capture.json'), 'utf8'));
/// Where a camera shows a place, pixels.
function seen(name, place) {
  const c = capture.cameras.find((one) => one.name === name);
  const [x, y, z] = c.world_to_camera.slice(0, 3).map((r) => r[0] * place[0] + r[1] * place[1] + r[2] * place[2] + r[3]);
  return [c.fx * x / z + c.cx, c.fy * y / z + c.cy];
}

test('points clicked in the page place the cameras, are saved, and finish the import', options, async () => {
  const running = await assist();
  const page = await browser.newPage({ viewport: { width: 1300, height: 900 }, hasTouch: true }), errors = [];
  page.setDefaultTimeout(PATIENCE);
  page.on('pageerror', (e) => errors.push(e.stack ?? e.message));
  await page.goto(running.url);
  await page.getByRole('button', { name: 'New point', exact: true }).waitFor();
  assert.ok(!(await page.evaluate(() => location.href)).includes('assist='), 'the token leaves the address bar');
  const idle = () => page.waitForFunction(() => document.body.dataset.idle === 'true', null, { timeout: PATIENCE });
  const canvas = (name) => page.getByLabel(`Image of ${name}`);
  /// A pixel of a camera's image in the page, where it is shown as a whole.
  const spot = async (name, [u, v]) => {
    const box = await canvas(name).boundingBox(), scale = Math.min(box.width / 400, box.height / 300);
    return [box.x + (box.width - scale * 400) / 2 + scale * u, box.y + (box.height - scale * 300) / 2 + scale * v];
  };
  for (const [k, place] of PLACES.entries()) {
    await page.getByRole('button', { name: 'New point', exact: true }).click();
    for (const name of CAMERAS) {
      const at = await spot(name, seen(name, place));
      // Half of them with a finger.
      if (k % 2) await page.touchscreen.tap(...at);
      else await page.mouse.click(...at);
    }
    await idle();
  }
  const status = page.getByRole('status').filter({ hasText: 'cameras' });
  const text = await status.innerText();
  const [, error] = /4 of 4 cameras, ([\d.]+) px/.exec(text) ?? assert.fail(text);
  assert.ok(Number(error) < 1, text);
  assert.match(await page.getByRole('list', { name: 'Points' }).innerText(), /point 8\s*4 clicks, \d\.\d px/);
  assert.match(await page.getByLabel('cam07', { exact: true }).innerText(), /focal length (2[89]\d|3[01]\d) px/);
  // A click on a wrong corner is far from its point; undo takes it back.
  const saved = () => JSON.parse(readFileSync(path.join(take, 'import/points.json'), 'utf8'));
  const before = saved();
  const far = await spot('cam12', seen('cam12', PLACES[7]).map((v) => v + 40));
  await page.mouse.click(...far);
  await idle();
  assert.notDeepEqual(saved(), before);
  assert.ok((await page.locator('li.bad').count()) > 0);
  await page.keyboard.press('Control+z');
  await idle();
  assert.deepEqual(saved(), before);
  // Zoom about a place, and move the mark by keys.
  const [x, y] = await spot('cam00', seen('cam00', PLACES[7]));
  await page.mouse.move(x, y);
  await page.mouse.wheel(0, -600);
  await canvas('cam00').focus();
  await page.keyboard.press('ArrowRight');
  await idle();
  const own = (all) => all.points[7].clicks.find((c) => c.camera === 'cam00').x;
  assert.ok(Math.abs(own(saved()) - own(before) - 0.25) < 1e-6);
  // An event in every camera, the floor, a length.
  for (const name of CAMERAS) {
    await page.getByLabel(name, { exact: true }).getByRole('button', { name: 'Event', exact: true }).click();
    await idle();
  }
  for (const k of [1, 2, 3, 4]) {
    await page.getByLabel(`point ${k} is on the floor`).check();
    await idle();
  }
  await page.getByLabel('From point').selectOption('point 1');
  await page.getByLabel('To point').selectOption('point 3');
  await page.getByLabel('Metres').fill(String(Math.sqrt(8)));
  await page.getByLabel('Metres').blur();
  await idle();
  const all = saved();
  assert.deepEqual([Object.keys(all.event), all.floor.length, all.length.points], [CAMERAS, 4, ['point 1', 'point 3']]);
  // A page that is opened again shows the points.
  await page.reload();
  await page.waitForFunction(() => document.querySelectorAll('aside li').length === 8);
  await idle();
  const response = await page.request.post(new URL('assist', running.url).href, { data: { load: true } });
  assert.equal(response.status(), 403, 'without the token nothing is accepted');
  await page.getByRole('button', { name: 'Finish', exact: true }).click();
  await page.getByText('The import continues in the terminal').waitFor();
  assert.equal(await running.ended, 0);
  const made = JSON.parse(readFileSync(path.join(take, 'capture.json'), 'utf8'));
  assert.deepEqual(made.cameras.map((c) => c.name), CAMERAS);
  assert.deepEqual(errors, []);
  await page.close();
});

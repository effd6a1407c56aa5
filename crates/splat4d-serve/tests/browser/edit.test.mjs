// Editing as people do it: the program serves a scene and a list, Chromium selects, deletes, moves, recolours, undoes
// and saves; a page without the token only looks. SPLAT4D names the program; without it these tests are skipped.

import assert from 'node:assert/strict';
import { spawn, execFileSync } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { boxOf, combined, easedKey, History, keysOf, movedTo, placeAt, shiftedKey, turnOf, quatOf, withBox, withKey, withoutKey }
  from '../../player/edit-steps.js';
import { launch } from './browser.mjs';

const KNIGHT = fileURLToPath(new URL('../../../../examples/knight.s4d', import.meta.url));
const PROGRAM = process.env.SPLAT4D;
const browser = PROGRAM && existsSync(PROGRAM) ? await launch() : null;
/// A wait that is longer than this, ms, has found a hang. Generous: machines that test are busy.
const PATIENCE = 120000;
const options = { skip: browser ? false : 'needs the program (SPLAT4D) and a browser', timeout: 3 * PATIENCE };
const work = mkdtempSync(path.join(tmpdir(), 'splat4d-edit-'));
const servers = [];
test.after(async () => {
  servers.forEach((s) => s.kill('SIGINT'));
  await browser?.close();
  rmSync(work, { recursive: true });
});

const near = (a, b, by = 1e-4) => a.forEach((x, i) => assert.ok(Math.abs(x - b[i]) <= by, `${a} is not ${b}`));

test('selections are combined as text', () => {
  assert.equal(combined('', 'all', 'add'), 'all');
  assert.equal(combined('a(1)', 'b(2)', 'new'), 'b(2)');
  assert.equal(combined('a(1)', 'b(2)', 'add'), 'a(1) or b(2)');
  assert.equal(combined('a(1) or b(2)', 'c(3)', 'remove'), '(a(1) or b(2)) and not c(3)');
  assert.equal(combined('a(1)', 'b(2) or c(3)', 'within'), 'a(1) and (b(2) or c(3))');
});

test('a move gets keys, and is interpolated between them', () => {
  const start = { do: 'move', select: 'all', to: { shift: [1, 0, 0], about: [0, 0, 1] } };
  let step = withKey(start, 0);
  assert.deepEqual([step.to, step.about], [undefined, [0, 0, 1]]);
  step = movedTo(step, 2, { shift: [3, 0, 0], quat: quatOf([0, 0, 1, 90]), scale: 4, about: [0, 0, 1] });
  assert.deepEqual(keysOf(step).map((k) => k.t), [0, 2]);
  const at = placeAt(step, 1);
  near(at.shift, [2, 0, 0]);
  near(turnOf(at.quat), [0, 0, 1, 45], 1e-3);
  near([at.scale], [2]);
  near(placeAt(easedKey(step, 0, true), 0.2).shift, [1 + 2 * 0.019, 0, 0]);
  assert.deepEqual(keysOf(shiftedKey(step, 2, 1.5)).map((k) => k.t), [0, 1.5]);
  const last = withoutKey(withoutKey(step, 2), 0);
  assert.deepEqual([last.keys, last.to], [undefined, { shift: [1, 0, 0], about: [0, 0, 1] }]);
});

test('the last box of a selection is read and replaced', () => {
  const text = 'box(0,0,0, 1,1,1) and not box(2, -1,0 3,1e0,-5)';
  assert.deepEqual(boxOf(text), { low: [2, -1, -5], high: [3, 1, 0] });
  assert.equal(withBox(text, { low: [0, 0, 0], high: [1, 2, 3] }), 'box(0,0,0, 1,1,1) and not box(0,0,0, 1,2,3)');
  for (const words of ['', 'all', 'box(1,2)', 'box(1,2,3, 4,5,x)', 'sandbox(0,0,0,1,1,1)']) assert.equal(boxOf(words), null);
});

test('edits are undone and redone', () => {
  const h = new History([]);
  h.push([1]);
  h.push([1, 2]);
  h.undo();
  assert.deepEqual([h.steps, h.undoable, h.redoable], [[1], true, true]);
  h.redo();
  assert.deepEqual([h.steps, h.redoable], [[1, 2], false]);
  h.undo();
  h.push([1, 3]);
  assert.equal(h.redoable, false);
});

/// Starts `view --edit` and waits for its address.
function view(file, list) {
  const child = spawn(PROGRAM, ['view', file, '--edit', list, '--no-open', '--json', '--port', '0'], { stdio: ['ignore', 'pipe', 'inherit'] });
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

/// A page that edits: {page, errors, said(), idle()}.
async function edit(url, size = { width: 900, height: 640 }, more = {}) {
  const page = await browser.newPage({ viewport: size, ...more }), errors = [];
  page.setDefaultTimeout(PATIENCE);
  page.on('pageerror', (e) => errors.push(e.stack ?? e.message));
  await page.goto(url);
  await page.getByRole('dialog', { name: 'Edit' }).waitFor({ timeout: PATIENCE });
  const panel = page.locator('.panel.edit');
  return {
    page, errors, panel,
    said: () => page.locator('.panel.edit .said').innerText(),
    act: (name) => panel.getByRole('button', { name, exact: true }).click(),
    tool: (name) => panel.getByRole('radio', { name, exact: true }).check({ force: true }),
    /// Nothing is worked on, and the scene is the newest.
    idle: async () => {
      await page.waitForTimeout(50);
      await page.waitForFunction(() => {
        const e = document.querySelector('splat-4d');
        return e.face.editing.idle && e.player.state === 'ready';
      }, null, { timeout: PATIENCE });
      await page.evaluate(() => document.querySelector('splat-4d').settled());
    },
    drag: async (from, to, steps = 4) => {
      await page.mouse.move(...from);
      await page.mouse.down();
      await page.mouse.move(...to, { steps });
      await page.mouse.up();
    },
    gaussians: () => page.evaluate(() => document.querySelector('splat-4d').player.meta.gaussians),
    steps: () => page.evaluate(() => document.querySelector('splat-4d').face.editing.steps),
  };
}

test('a lasso on the image deletes, undo restores, and the list is saved', options, async (t) => {
  const list = path.join(work, 'edits.toml');
  const url = await view(KNIGHT, list);
  assert.match(url, /#edit=[0-9a-f]{32}$/);
  const e = await edit(url), { page } = e;
  assert.ok(!(await page.evaluate(() => location.href)).includes('edit='), 'the token leaves the address bar');
  const whole = await e.gaussians();
  await e.tool('Lasso');
  await page.mouse.move(430, 180);
  await page.mouse.down();
  for (const p of [[560, 200], [560, 330], [400, 330], [420, 200]]) await page.mouse.move(...p, { steps: 5 });
  await page.mouse.up();
  await page.waitForFunction(() => /Gaussians/.test(document.querySelector('splat-4d').shadowRoot.querySelector('.said').textContent));
  const held = Number((await e.said()).split(' ')[0].replace(/,/g, ''));
  assert.ok(held > 0 && held < whole, `${held} of ${whole}`);
  assert.match(await page.evaluate(() => document.querySelector('splat-4d').face.editing.text), /^lasso\(/);
  const began = Date.now();
  await e.act('Delete');
  await e.idle();
  t.diagnostic(`${held} deleted and played after ${Date.now() - began} ms`);
  const less = await e.gaussians();
  assert.ok(less < whole, `${less} of ${whole}`);
  await page.keyboard.press('Control+z');
  await e.idle();
  assert.equal(await e.gaussians(), whole);
  await page.keyboard.press('Control+y');
  await e.idle();
  assert.equal(await e.gaussians(), less);
  assert.ok(!existsSync(list), 'nothing is written before it is saved');
  await page.keyboard.press('Control+s');
  await page.waitForFunction(() => !document.querySelector('splat-4d').face.editing.history.dirty);
  const text = readFileSync(list, 'utf8');
  assert.match(text, /do = "delete"/);
  assert.match(text, /lasso\(/);
  // The same list on the command line makes the same scene.
  const out = path.join(work, 'out.s4d');
  const said = execFileSync(PROGRAM, ['edit', KNIGHT, list, '-o', out, '--json']).toString();
  assert.match(said, new RegExp(`"selected":${held}`));
  assert.deepEqual(e.errors, []);
  await page.close();
});

test('selections, colours, moves by handles, keys on the time line; errors are shown', options, async () => {
  const e = await edit(await view(KNIGHT, path.join(work, 'moves.toml'))), { page, panel } = e;
  const area = panel.getByLabel('Selection as text');
  await area.fill('bux(1)');
  await area.blur();
  await page.waitForFunction(() => /no predicate/.test(document.querySelector('splat-4d').shadowRoot.querySelector('.said').textContent));
  await area.fill('all');
  await area.blur();
  await page.waitForFunction(() => /visible now/.test(document.querySelector('splat-4d').shadowRoot.querySelector('.said').textContent));
  await e.act('Colour');
  await e.idle();
  await panel.getByLabel('Exposure, stops').fill('-2');
  await e.idle();
  assert.equal((await e.steps())[0].exposure, -2);
  await e.act('Change edit 1: Colour');
  await area.fill('all');
  await area.blur();
  await page.waitForFunction(() => document.querySelector('splat-4d').face.editing.acts.children[0].disabled === false);
  await e.act('Move');
  await page.waitForFunction(() => document.querySelector('splat-4d').face.editing.overlay.place);
  // The handles: the middle goes along the image, a ring turns.
  const middle = await page.evaluate(() => {
    const o = document.querySelector('splat-4d').face.editing.overlay;
    return o.project([0, 1, 2].map((k) => o.place.about[k] + o.place.shift[k]));
  });
  await e.drag(middle, [middle[0] + 60, middle[1] - 20]);
  await e.idle();
  const shift = (await e.steps())[1].to.shift;
  assert.ok(Math.hypot(...shift) > 0, `${shift}`);
  await e.act('Add key here');
  await page.evaluate(() => { const p = document.querySelector('splat-4d').player; p.seek(p.first + p.duration / 2); });
  // A key is set at the time that is shown.
  await page.waitForFunction(() => {
    const p = document.querySelector('splat-4d').player;
    return Math.abs(p.time - (p.first + p.duration / 2)) < 0.05;
  });
  await panel.getByLabel('Shift z').fill('0.5');
  await panel.getByLabel('Shift z').blur();
  await e.idle();
  const { keys } = (await e.steps())[1];
  assert.equal(keys.length, 2);
  assert.equal(keys[1].shift[2], 0.5);
  assert.equal(await page.locator('.editkey').count(), 2);
  // A key is dragged along the time line.
  const box = await page.locator('.editkey').nth(1).boundingBox();
  await e.drag([box.x + box.width / 2, box.y + box.height / 2], [box.x + 120, box.y + box.height / 2]);
  await e.idle();
  assert.ok((await e.steps())[1].keys[1].t > keys[1].t);
  await page.keyboard.press('Escape');
  assert.equal(await page.evaluate(() => document.querySelector('splat-4d').face.editing.active), -1);
  assert.deepEqual(e.errors, []);
  await page.close();
});

test('one finger draws and two move the camera', options, async () => {
  const e = await edit(await view(KNIGHT, path.join(work, 'touch.toml')), { width: 390, height: 760 }, { hasTouch: true, isMobile: true });
  const { page } = e;
  await e.tool('Box');
  const client = await page.context().newCDPSession(page);
  const touch = (type, ...points) => client.send('Input.dispatchTouchEvent', { type, touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
  const camera = () => page.evaluate(() => JSON.stringify(document.querySelector('splat-4d').camera));
  const before = await camera();
  // Above the panel.
  const at = [80, 120];
  await touch('touchStart', at);
  await touch('touchMove', [at[0] + 60, at[1] + 60]);
  await touch('touchMove', [at[0] + 220, at[1] + 190]);
  await touch('touchEnd');
  await page.waitForFunction(() => document.querySelector('splat-4d').face.editing.said.textContent !== '');
  assert.equal(await camera(), before, 'one finger draws');
  await touch('touchStart', at);
  await touch('touchStart', at, [at[0] + 60, at[1]]);
  await touch('touchMove', [at[0] - 30, at[1]], [at[0] + 90, at[1]]);
  await touch('touchEnd');
  await page.waitForTimeout(50);
  assert.notEqual(await camera(), before, 'two move the camera');
  assert.deepEqual(e.errors, []);
  await page.close();
});

test('without the token a page cannot edit, and other origins cannot send requests', options, async () => {
  const url = await view(KNIGHT, path.join(work, 'none.toml')), base = url.split('#')[0];
  const page = await browser.newPage();
  await page.goto(base);
  await page.waitForFunction(() => document.querySelector('splat-4d')?.statistics?.firstFrame > 0, null, { timeout: PATIENCE });
  assert.equal(await page.locator('.panel.edit').count(), 0);
  const status = (headers) => page.evaluate(async (headers) => (await fetch('/edit', { method: 'POST', headers, body: '{"do":"open"}' })).status, headers);
  assert.equal(await status({ 'content-type': 'application/json' }), 403);
  assert.equal(await status({ 'content-type': 'application/json', 'x-splat4d-token': '0'.repeat(32) }), 403);
  const token = url.split('=')[1];
  assert.equal(await status({ 'content-type': 'application/json', 'x-splat4d-token': token }), 200);
  // Another origin on this machine, with the token: the browser sends a preflight request, which is refused.
  const other = await view(KNIGHT, path.join(work, 'other.toml'));
  const foreign = await browser.newPage();
  await foreign.goto(other.split('#')[0]);
  const outcome = await foreign.evaluate(async ([address, token]) => {
    try {
      return (await fetch(`${address}edit`, { method: 'POST', body: '{"do":"open"}',
        headers: { 'content-type': 'application/json', 'x-splat4d-token': token } })).status;
    } catch (error) { return error.name; }
  }, [base, token]);
  assert.equal(outcome, 'TypeError');
  await page.close();
  await foreign.close();
});

test('after a reload unsaved edits are in the list; another page begins with what is saved', options, async () => {
  const url = await view(KNIGHT, path.join(work, 'kept.toml'));
  const e = await edit(url), { page, panel } = e, whole = await e.gaussians();
  page.on('dialog', (d) => d.accept());
  assert.equal(await panel.getByRole('button', { name: 'Delete', exact: true }).getAttribute('title'), 'Select something first');
  await panel.getByRole('button', { name: 'Speed', exact: true }).click();
  assert.match(await page.evaluate(() => document.querySelector('splat-4d').face.editing.text), /^speed\(/);
  const area = panel.getByLabel('Selection as text');
  await area.fill('box(-99,-99,-99, 0,99,99)');
  await area.blur();
  await page.waitForFunction(() => /Gaussians/.test(document.querySelector('splat-4d').shadowRoot.querySelector('.said').textContent));
  await e.act('Delete');
  await e.idle();
  const less = await e.gaussians();
  assert.ok(less < whole);
  await page.reload();
  await panel.waitFor({ timeout: PATIENCE });
  await e.idle();
  assert.deepEqual([await e.gaussians(), (await e.steps()).length, await panel.getByRole('listitem').count()], [less, 1, 1]);
  // Another tab has no part in it, and gets the scene of the saved list.
  const other = await edit(url);
  await other.idle();
  assert.deepEqual([await other.gaussians(), await other.steps()], [whole, []]);
  await other.page.close();
  await page.keyboard.press('Control+z');
  await e.idle();
  assert.deepEqual([await e.gaussians(), await e.steps()], [whole, []]);
  // The same while the program still works on the edit: the reload breaks the request off.
  let held = true;
  await page.route('**/edit', (route) => (held && route.request().postData().includes('"bake"') ? null : route.continue()));
  await area.fill('box(-99,-99,-99, 0,99,99)');
  await area.blur();
  await page.waitForFunction(() => /Gaussians/.test(document.querySelector('splat-4d').shadowRoot.querySelector('.said').textContent));
  const asked = page.waitForRequest((request) => request.postData()?.includes('"bake"'));
  await e.act('Delete');
  await asked;
  await page.reload();
  held = false;
  await panel.waitFor({ timeout: PATIENCE });
  await e.idle();
  assert.deepEqual([await e.gaussians(), (await e.steps()).length], [less, 1]);
  assert.deepEqual([e.errors, other.errors], [[], []]);
  await page.close();
});

test('the box of a selection has numbers and faces that can be pulled', options, async () => {
  const e = await edit(await view(KNIGHT, path.join(work, 'box.toml'))), { page, panel } = e;
  const area = panel.getByLabel('Selection as text'), text = () => page.evaluate(() => document.querySelector('splat-4d').face.editing.text);
  assert.equal(await panel.getByRole('group', { name: 'Box' }).isVisible(), false);
  await area.fill('box(-1,0,-1, 1,2,1)');
  await area.blur();
  await e.idle();
  const top = panel.getByLabel('Box y to');
  assert.equal(await top.inputValue(), '2');
  await top.fill('1.5');
  await top.blur();
  assert.equal(await text(), 'box(-1,0,-1, 1,1.5,1)');
  // The middle of the upper face, pulled upwards.
  const at = await page.evaluate(() => document.querySelector('splat-4d').face.editing.overlay.project([0, 1.5, 0]));
  const camera = await page.evaluate(() => document.querySelector('splat-4d').camera.position);
  await e.drag(at.slice(0, 2), [at[0], at[1] - 40]);
  await e.idle();
  const height = Number(await top.inputValue());
  assert.ok(height > 1.6, `${height}`);
  assert.match(await text(), new RegExp(`^box\\(-1,0,-1, 1,${height},1\\)$`));
  assert.deepEqual(await page.evaluate(() => document.querySelector('splat-4d').camera.position), camera, 'the camera stays');
  if (process.env.SHOTS) await page.screenshot({ path: `${process.env.SHOTS}/box.png` });
  assert.deepEqual(e.errors, []);
  await page.close();
});

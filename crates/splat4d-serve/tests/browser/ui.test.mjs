// The player's interface in a real browser: keys, scrubbing, links, the element in a bare page, names for screen
// readers, errors, narrow windows, live training. Files and images are stand-ins (mock/), so that this tests the
// interface alone. Run: node --test ui.test.mjs (see browser.mjs for what it needs).

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { after, before, test } from 'node:test';
import { launch } from './browser.mjs';
import { firstCamera } from '../../player/camera.js';
import { Cost, Flight, Pace } from '../../player/pace.js';
import { Site } from './ui-harness.mjs';

/** Seconds on the mock's clock: its clip begins at 1 and lasts 4, 25 frames per second. */
const FIRST = 1, LAST = 5, FRAME = 1 / 25;
const browser = await launch();
const options = { skip: browser ? false : 'no browser', timeout: 60000 };
let site;

before(async () => { site = await new Site().start(); });
after(async () => {
  await browser?.close();
  await site.stop();
});

/** A page at `path`, ready; errors on its console fail the test unless `wrong` is set. */
async function open(path = '', { size = [1000, 700], config, wrong = false, ready = true, ...more } = {}) {
  site.config = config ?? { title: 'Two knights', scene: 'scene.s4d', live: false, autoplay: false };
  const viewport = { width: size[0], height: size[1] };
  const context = await browser.newContext({ viewport, acceptDownloads: true, ...more });
  const page = await context.newPage();
  const errors = [];
  page.on('pageerror', e => errors.push(e.stack));
  page.on('console', m => m.type() === 'error' && errors.push(m.text()));
  await page.goto(site.url + path);
  const waiting = ready && page.waitForFunction(() => document.querySelector('splat-4d')?.player?.state === 'ready');
  // What the page said explains why it is not ready.
  if (ready) await waiting.catch(e => { throw new Error([e.message, ...errors].join('\n')); });
  return {
    page, context,
    /** f(element, argument) in the page. */
    ask: (f, arg) => page.$eval('splat-4d', f, arg),
    done: async () => {
      await context.close();
      if (!wrong) assert.deepEqual(errors, [], 'no errors on the console');
    },
  };
}

const near = (a, b, by = 1e-3) => assert.ok(Math.abs(a - b) <= by, `${a} is not ${b}`);
/** Two frames on, and until the image of a seek is there. */
const settle = async page => {
  await page.evaluate(() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done))));
  await page.waitForFunction(() => !document.querySelector('splat-4d').player.seeking);
};

test('the page preloads every module', () => {
  const text = name => readFileSync(new URL(`../../player/${name}`, import.meta.url), 'utf8');
  const met = new Set(['page.js']);
  for (const name of met) {
    for (const [, next] of text(name).matchAll(/^(?:import|export)(?:[^;']*from)? '\.\/([\w.-]+)'/gm)) met.add(next);
  }
  const named = [...text('index.html').matchAll(/modulepreload" href="\.\/([\w.-]+)"/g)].map(m => m[1]);
  assert.deepEqual(named.sort(), [...met].sort());
});

test('the stand-in for files has every method that the player calls', () => {
  const text = name => readFileSync(new URL(`../../player/${name}`, import.meta.url), 'utf8');
  const calls = ['player.js', 'element.js'].flatMap(name => [...text(name).matchAll(/\bfile\??\.(\w+)\(/g)].map(m => m[1]));
  const methods = [...text('scene-file.js').matchAll(/^  (?:static |async )*(\w+)\(.*\) \{$/gm)].map(m => m[1]);
  const used = methods.filter(name => calls.includes(name));
  assert.ok(used.includes('watch'), `${used}`);
  const standIn = readFileSync(new URL('mock/scene-file.js', import.meta.url), 'utf8');
  assert.deepEqual(used.filter(name => !new RegExp(`^  (?:static |async )*${name}\\(`, 'm').test(standIn)), []);
});

test('the resolution falls as far as needed and useful, and rises again', () => {
  /** Plays `seconds` on a synthetic machine where a frame takes fixed + pixels·scale² ms, at most 60 frames per second. */
  const play = (pace, fixed, pixels, seconds = 20) => {
    const scales = [];
    for (let now = 0; now < 1000 * seconds;) {
      const ms = Math.max(1000 / 60, fixed + pixels * pace.scale ** 2);
      now += ms;
      pace.frame(ms, now + (pace.clock ?? 0));
      scales.push(pace.scale);
    }
    pace.clock = (pace.clock ?? 0) + 1000 * seconds;
    return scales;
  };
  const slow = new Pace();
  play(slow, 4, 120);
  assert.ok(slow.fps >= 28.5 && slow.scale > 0.3 && slow.scale < 0.5, `${slow.fps} frames/s at ${slow.scale}`);
  play(slow, 4, 5);
  assert.equal(slow.scale, 1, 'a machine that is free again gives the whole picture');
  const busy = play(new Pace(), 100, 1);
  assert.ok(busy.filter(s => s < 1).length < busy.length / 4, 'where pixels are not what is slow, they stay');
  assert.ok(play(new Pace(), 2, 6).every(s => s === 1));
  assert.equal(Math.min(...play(new Pace(), 1, 5000, 60)), 0.25);
});

test('the cost of a frame at another resolution is predicted from two', () => {
  const cost = new Cost();
  assert.equal(cost.at(1), 0);
  // 80 ms for every frame and 240 for the pixels, as on a slow device; the first frame also waits for shaders.
  const frame = scale => 80 + 240 * scale ** 2;
  cost.record(0.5, 900);
  near(cost.at(1), 3600);
  cost.record(0.5, frame(0.5));
  cost.record(0.25, frame(0.25));
  near(cost.at(1), frame(1), 1e-6);
  near(cost.at(0.25), frame(0.25), 1e-6);
  near(frame(cost.within(200, 0.25)), 200, 1e-6);
  assert.deepEqual([cost.within(10, 0.25), cost.within(9000, 0.25)], [0.25, 1]);
  const flight = new Flight();
  // The second waits for the first.
  for (const [what, now] of [['begin', 0], ['begin', 10], ['end', 100], ['end', 180]]) flight[what](now);
  assert.deepEqual([flight.count, flight.ms], [0, 80]);
});

test('keys play, seek, step, change speed, channel and camera', options, async () => {
  const { page, ask, done } = await open();
  const state = () => ask(e => ({ t: e.currentTime, paused: e.paused, speed: e.player.speed, channel: e.player.channel,
    camera: e.camera, loop: e.player.loop, viewed: e.player.viewed, mode: e.player.controls.mode }));
  const press = async key => { await page.keyboard.press(key); await settle(page); return state(); };
  assert.equal((await state()).paused, true);
  assert.equal((await press('Space')).paused, false);
  await page.waitForFunction(() => document.querySelector('splat-4d').currentTime > 1.1);
  assert.equal((await press('Space')).paused, true);
  near((await press('Home')).t, FIRST);
  near((await press('.')).t, FIRST + FRAME);
  near((await press('.')).t, FIRST + 2 * FRAME);
  near((await press(',')).t, FIRST + FRAME);
  near((await press('ArrowRight')).t, FIRST + FRAME + 0.4);
  near((await press('ArrowLeft')).t, FIRST + FRAME);
  near((await press('End')).t, LAST);
  near((await press('ArrowRight')).t, LAST);
  assert.equal((await press(']')).speed, 1.5);
  assert.equal((await press('[')).speed, 1);
  assert.equal((await press('[')).speed, 0.75);
  assert.equal((await press('c')).channel, 'depth');
  for (const channel of ['alpha', 'flow', 'color']) assert.equal((await press('c')).channel, channel);
  assert.equal((await press('l')).loop, false);
  assert.equal((await press('m')).mode, 'fly');
  await press('2');
  await page.waitForFunction(() => document.querySelector('splat-4d').camera.position[0] === -4);
  assert.equal((await state()).viewed, 1);
  await press('r');
  await page.waitForFunction(() => document.querySelector('splat-4d').camera.position[2] === 4.5);
  const before = (await state()).camera.position;
  await page.keyboard.down('w');
  // w flies ahead.
  await page.waitForFunction(z => document.querySelector('splat-4d').camera.position[2] < z - 0.02, before[2]);
  await page.keyboard.up('w');
  await settle(page);
  const still = (await state()).camera.position;
  await page.waitForTimeout(100);
  assert.deepEqual((await state()).camera.position, still, 'and stops when it is let go');
  await press('h');
  assert.ok(await page.getByRole('dialog', { name: 'Keys and gestures' }).isVisible());
  await press('Escape');
  assert.equal(await page.getByRole('dialog', { name: 'Keys and gestures' }).count(), 0);
  await done();
});

test('the mouse orbits about the target, the wheel goes nearer, touch pinches', options, async () => {
  const { page, ask, done } = await open();
  const camera = () => ask(e => e.camera);
  const far = c => Math.hypot(...c.position.map((x, i) => x - c.target[i]));
  const a = await camera();
  await page.mouse.move(500, 300);
  await page.mouse.down();
  await page.mouse.move(560, 320, { steps: 4 });
  await page.waitForTimeout(200);
  // Dragged right, the camera goes left; dragged down, it rises.
  await page.waitForFunction(([x, y]) => {
    const [now, high] = document.querySelector('splat-4d').camera.position;
    return now < x - 0.5 && high > y + 0.1;
  }, a.position);
  await page.mouse.up();
  const b = await camera();
  a.target.forEach((x, i) => near(b.target[i], x));
  near(far(b), far(a));
  await page.mouse.wheel(0, -200);
  await settle(page);
  assert.ok(far(await camera()) < far(b) * 0.8);
  const c = await camera();
  const finger = (type, id, x, y) => ask((e, [type, id, x, y]) => {
    const stage = e.shadowRoot.querySelector('.stage');
    stage.setPointerCapture = () => {};
    const at = { pointerId: id, pointerType: 'touch', clientX: x, clientY: y, bubbles: true };
    stage.dispatchEvent(new PointerEvent(type, at));
  }, [type, id, x, y]);
  await finger('pointerdown', 11, 400, 300);
  await finger('pointerdown', 12, 600, 300);
  await finger('pointermove', 11, 300, 300);
  await finger('pointermove', 12, 700, 300);
  near(far(await camera()) / far(c), 0.5);
  await finger('pointerup', 11, 300, 300);
  await finger('pointerup', 12, 700, 300);
  await done();
});

test('the time slider scrubs by mouse and keys, and shows what is buffered', options, async () => {
  const { page, ask, done } = await open();
  const slider = page.getByRole('slider', { name: 'Time' });
  const rail = await ask(e => e.shadowRoot.querySelector('.rail').getBoundingClientRect().toJSON());
  await page.mouse.move(rail.left + rail.width / 2, rail.top + 1);
  await page.mouse.down();
  // The slider is where the pointer is; the clock reads what is shown, which is the old image until pages of the new
  // time came.
  const read = () => ask(e => [e.player.target, e.currentTime, e.player.seeking, e.shadowRoot.querySelector('.time b').textContent]);
  const [target, shown, seeking, clock] = await read();
  near(target, 3, 0.02);
  assert.ok(seeking ? shown === FIRST && clock === '0:00.00' : Math.abs(shown - 3) < 0.02, `${[target, shown, seeking, clock]}`);
  const arrives = time => page.waitForFunction(t => Math.abs(document.querySelector('splat-4d').currentTime - t) < 0.02, time);
  await arrives(3);
  await page.mouse.move(rail.left + rail.width * 0.75, rail.top + 1);
  await arrives(4);
  await page.mouse.up();
  assert.match(await slider.getAttribute('aria-valuetext'), /^3\.0\d of 4\.00 seconds$/);
  near(+await slider.getAttribute('aria-valuemax'), 4);
  await slider.focus();
  await page.keyboard.press('PageDown');
  await arrives(3.6);
  await page.keyboard.press('Home');
  await arrives(FIRST);
  const there = () => ask(e => [...e.shadowRoot.querySelectorAll('.there')].map(i => [i.style.left, i.style.width])
    .sort((a, b) => parseFloat(a[0]) - parseFloat(b[0])));
  await page.waitForFunction(() => {
    return document.querySelector('splat-4d').shadowRoot.querySelectorAll('.there').length === 2;
  });
  // Pages 0 and 1 of the beginning, 4 and 5 of where it was scrubbed to (and 3, where the pointer passed).
  const spans = await there();
  assert.equal(spans[0][0], '0%');
  assert.ok(parseFloat(spans[0][1]) < 40 && parseFloat(spans[1][0]) > 45, JSON.stringify(spans));
  await done();
});

test('a link restores camera, time, channel and playing', options, async () => {
  const first = await open();
  await first.page.mouse.move(500, 300);
  await first.page.mouse.down();
  await first.page.mouse.move(430, 340, { steps: 3 });
  await first.page.waitForTimeout(200);
  await first.page.mouse.up();
  await first.page.keyboard.press('c');
  await first.ask(e => e.seek(2.5));
  await settle(first.page);
  const [link, camera] = await first.ask(e => [e.link, e.camera]);
  await first.done();
  const second = await open(`#${link}`);
  const got = await second.ask(e => (
    { camera: e.camera, t: e.currentTime, channel: e.player.channel, paused: e.paused }));
  camera.position.forEach((x, i) => near(got.camera.position[i], x, 1e-4));
  camera.quat.forEach((x, i) => near(got.camera.quat[i], x, 1e-4));
  near(got.camera.fov, camera.fov);
  assert.deepEqual([got.t, got.channel, got.paused], [2.5, 'depth', true]);
  // An address that changes under the page is followed; one with nonsense harms nothing.
  await second.page.evaluate(() => { location.hash = '#p=0,1,7&target=0,1,0&fov=30&t=4&ch=alpha&play=1'; });
  await second.page.waitForFunction(() => !document.querySelector('splat-4d').paused);
  assert.deepEqual(await second.ask(e => e.camera.position), [0, 1, 7]);
  await second.page.evaluate(() => { location.hash = '#p=a,b&q=&t=x&ch=smell&fov=-1'; });
  await settle(second.page);
  assert.deepEqual(await second.ask(e => [e.camera.position, e.player.channel]), [[0, 1, 7], 'alpha']);
  await second.done();
});

test('the element works in a bare page: attributes, events, methods', options, async () => {
  site.pages['/bare'] = `<!doctype html><title>bare</title><body style="margin:0;height:3000px">
    <script type="module" src="/player/element.js"></script>
    <script>window.heard = []; for (const n of ['load', 'play', 'pause', 'timeupdate', 'camerachange', 'error'])
      addEventListener('DOMContentLoaded', () => document.querySelector('splat-4d')
        .addEventListener(n, e => heard.push([n, e.detail])));</script>
    <splat-4d src="scene.s4d" time="2" speed="2" channel="alpha" backend="webgl2" background="#ff8000"
      camera="0,1,6 0,1,0 30" heading="Bare&#x202e;gpj" style="width:600px"></splat-4d>`;
  const { page, ask, done } = await open('bare');
  const drawn = await ask(e => ({ ...e.player.backend.drawn, bg: e.player.drawing(10, 10).background, t: e.currentTime,
    speed: e.player.speed, camera: e.camera, backend: e.player.backend.name, paused: e.paused,
    height: e.getBoundingClientRect().height }));
  assert.deepEqual([drawn.t, drawn.speed, drawn.channel, drawn.backend, drawn.paused], [2, 2, 'alpha', 'webgl2', true]);
  assert.deepEqual(drawn.camera.position, [0, 1, 6]);
  assert.equal(drawn.camera.fov, 30);
  near(drawn.height, 337.5, 0.6);
  // Characters that would turn the text's direction are spelt out.
  assert.equal(await ask(e => e.face.title.textContent), String.raw`Bare\u{202e}gpj`);
  drawn.bg.forEach((x, i) => near(x, [1, 128 / 255, 0][i]));
  const names = () => page.evaluate(() => window.heard.map(h => h[0]));
  assert.ok((await names()).includes('load'));
  await ask(e => e.play());
  await page.waitForFunction(() => document.querySelector('splat-4d').currentTime > 2.2);
  await ask(e => e.pause());
  await ask(e => { e.camera = { position: [1, 1, 5], target: [0, 1, 0] }; });
  await settle(page);
  for (const name of ['play', 'pause', 'timeupdate', 'camerachange']) assert.ok((await names()).includes(name), name);
  const shot = await ask(async e => {
    const blob = await e.screenshot(), bytes = new Uint8Array(await blob.arrayBuffer());
    const bitmap = await createImageBitmap(blob);
    return { type: blob.type, head: [...bytes.slice(1, 4)], size: [bitmap.width, bitmap.height] };
  });
  assert.deepEqual([shot.type, shot.head, shot.size[0]], ['image/png', [80, 78, 71], 600]);
  // The page's own keys and scrolling stay the page's until the scene is in use.
  await page.evaluate(() => document.activeElement.blur());
  const t = await ask(e => e.currentTime);
  await page.keyboard.press('Home');
  near(await ask(e => e.currentTime), t);
  await page.mouse.move(300, 150);
  await page.mouse.wheel(0, 100);
  await page.waitForFunction(() => scrollY > 0);
  await ask(e => e.setAttribute('channel', 'flow'));
  assert.equal(await ask(e => e.player.channel), 'flow');
  const before = await ask(e => e.player);
  await ask(e => e.setAttribute('src', 'still.s4d'));
  await page.waitForFunction(() => document.querySelector('splat-4d').duration === 0);
  assert.ok(before !== undefined);
  await ask(e => e.remove());
  await page.waitForTimeout(50);
  assert.equal(await page.evaluate(() => document.querySelectorAll('splat-4d').length), 0);
  await done();
});

test('every control has a name, and the keyboard reaches it', options, async () => {
  const { page, ask, done } = await open('', { size: [1200, 800] });
  await page.keyboard.press('k');
  for (const name of ['Cameras and paths', 'View and settings']) {
    await page.getByRole('button', { name }).click();
    const nameless = await ask(e => [...e.shadowRoot
      .querySelectorAll('button, select, input, [role=slider], [tabindex]')]
      .filter(n => n.checkVisibility()).filter(n => !(n.getAttribute('aria-label') || n.textContent.trim()))
      .map(n => n.outerHTML));
    assert.deepEqual(nameless, []);
  }
  const titles = await ask(e => [...e.shadowRoot.querySelectorAll('[title]')].map(n => n.title));
  assert.ok(!titles.includes('The scene is static'), 'controls of a scene that moves');
  const tree = await page.locator('splat-4d').ariaSnapshot();
  for (const part of ['application "Scene: Two knights"', 'toolbar "Playback"', 'slider "Time"', 'button "Play"',
    'button "Loop"', 'combobox "Speed"', 'radiogroup "Channel"', 'radio "Depth"', 'button "Cameras and paths"',
    'dialog "View"', 'combobox "Resolution"', 'radiogroup "Theme"', 'button "Save image"', 'button "Copy link"',
    'button "Full screen"', 'button "Keys and gestures"']) {
    assert.ok(tree.includes(part), `${part} in\n${tree}`);
  }
  assert.doesNotMatch(tree, /- (button|slider|combobox|radio|checkbox)( \[|:|$)/m, 'nothing without a name');
  // From the closed panel one gets through all of the bar by tab, and a radio button keeps its own keys.
  await page.keyboard.press('Escape');
  await ask(e => e.shadowRoot.querySelector('.stage').focus());
  const met = new Set();
  for (let i = 0; i < 30; i++) {
    await page.keyboard.press('Tab');
    met.add(await ask(e => e.shadowRoot.activeElement?.getAttribute('aria-label')));
  }
  for (const name of ['Time', 'Play', 'One frame back', 'Speed', 'Colour', 'Full screen']) {
    assert.ok(met.has(name), name);
  }
  await ask(e => e.shadowRoot.querySelector('.bar input[value=color]').focus());
  await page.keyboard.press('ArrowRight');
  assert.equal(await ask(e => e.player.channel), 'depth');
  near(await ask(e => e.currentTime), FIRST);
  await done();
});

test('errors state the cause, the place and the remedy; the page recovers', options, async () => {
  const { page, ask, done } = await open('', { config: { scene: 'broken.s4d' }, ready: false });
  const alert = page.getByRole('alert');
  await alert.waitFor();
  const text = await alert.innerText();
  for (const part of ['The index is damaged', 'broken.s4d', 'Fetch or bake it again']) {
    assert.ok(text.includes(part), text);
  }
  await ask(e => { e.scene = new File([new Uint8Array(9)], 'good.s4d'); });
  await page.waitForFunction(() => document.querySelector('splat-4d').player.state === 'ready');
  assert.equal(await page.getByRole('alert').count(), 0);
  await done();
  const empty = await open('', { config: {}, ready: false });
  await empty.page.getByRole('button', { name: 'Choose a file' }).waitFor();
  const chooser = empty.page.waitForEvent('filechooser');
  await empty.page.getByRole('button', { name: 'Choose a file' }).click();
  await (await chooser).setFiles({ name: 'mine.s4d', mimeType: '', buffer: Buffer.from([1]) });
  await empty.page.waitForFunction(() => document.querySelector('splat-4d').player.state === 'ready');
  await empty.done();
});

test('a narrow window shows everything without horizontal scrolling', options, async () => {
  for (const size of [[390, 844], [360, 640], [640, 360], [320, 568]]) {
    const { page, ask, done } = await open('', { size, hasTouch: true });
    const check = async what => {
      const out = await ask(e => [...e.shadowRoot.querySelectorAll('button, select, .card')]
        .filter(n => n.checkVisibility())
        .filter(n => { const b = n.getBoundingClientRect(); return b.left < -0.5 || b.right > innerWidth + 0.5; })
        .map(n => n.outerHTML.slice(0, 80)));
      assert.deepEqual(out, [], `${what} at ${size}`);
      assert.ok(await page.evaluate(() => document.documentElement.scrollWidth <= innerWidth));
    };
    await check('the bar');
    for (const name of ['Cameras and paths', 'View and settings']) {
      await page.getByRole('button', { name }).click();
      await check(name);
    }
    const small = await ask(e => [...e.shadowRoot.querySelectorAll('.bar button')].filter(n => n.checkVisibility())
      .map(n => n.getBoundingClientRect()).filter(b => b.width < 36 || b.height < 36).length);
    assert.equal(small, 0, 'buttons are large enough for a finger');
    await page.keyboard.press('Escape');
    await page.keyboard.press('h');
    await check('the help');
    await done();
  }
});

test('an upright phone shows the subject larger, with duration and speed; the hint appears once', options, async () => {
  const { page, ask, done } = await open('', { size: [390, 844], hasTouch: true, isMobile: true });
  const seen = await ask(e => {
    const p = e.player, shown = name => e.shadowRoot.querySelector(name).checkVisibility();
    const f = (w, h) => p.camera.view(w, h).fx / w;
    const out = { tall: f(390, 844), square: f(400, 400), wide: p.camera.view(800, 400).fx / 400, shown: ['.of', '.speed'].map(shown) };
    const before = p.camera.view(390, 844).fx;
    p.camera.loosen(390, 844);
    return { ...out, moved: p.camera.view(390, 844).fx / before, hint: e.shadowRoot.querySelector('.hint.on')?.textContent };
  });
  near(seen.tall / seen.square, 4 / 3);
  near(seen.wide, seen.square);
  near(seen.moved, 1);
  assert.deepEqual(seen.shown, [true, true]);
  assert.match(seen.hint, /Drag to turn/);
  await page.getByRole('button', { name: 'View and settings' }).click();
  assert.ok(await page.getByRole('radio', { name: 'Depth' }).isVisible(), 'the channel is in the view panel');
  await page.touchscreen.tap(200, 200);
  assert.equal(await ask(e => e.shadowRoot.querySelector('.hint.on')), null, 'a touch ends the hint');
  await page.reload();
  await page.waitForFunction(() => document.querySelector('splat-4d')?.player?.state === 'ready');
  assert.equal(await ask(e => e.shadowRoot.querySelector('.hint.on')), null, 'it was shown before');
  // The third camera of the capture is shown whole.
  assert.ok(await ask(e => { e.player.controls.swing = false; e.player.view(2); return e.player.camera.view(390, 844).fx / 900 * 800 <= 390.01; }));
  await done();
});

test('the first view of a tall window shows as little as possible of what no camera saw', () => {
  /** A camera at this angle of an arc that looks down at the origin, its image at most as high as wide. */
  const camera = angle => {
    const [s, c] = [Math.sin(angle), Math.cos(angle)], tilt = 0.26, [a, b] = [Math.sin(tilt), Math.cos(tilt)];
    const world_from_camera = [c, s * a, -s * b, 6 * s * b, 0, -b, -a, 6 * a, -s, c * a, -c * b, 6 * c * b];
    return { world_from_camera, width: 400, height: 300, fx: 300, fy: 300, cx: 200, cy: 150 };
  };
  const meta = { up: [0, 1, 0], box: [[-5, -1, -5], [5, 4, 5]], cameras: [-0.9, -0.6, -0.3, 0, 0.3, 0.6, 0.9].map(camera),
    view: { position: [0, 1.6, 5.8], target: [0, 0, 0], fov_y: 53 } };
  const first = firstCamera(meta), [width, height] = [390, 844], view = first.view(width, height);
  assert.ok(view.cy < height / 2 - 40, `the axis is above the middle: ${view.cy}`);
  const [top, bottom] = first.seen, missing = { above: top + view.cy / view.fy, below: (height - view.cy) / view.fy - bottom };
  assert.ok(bottom - top > 1 && missing.above < 0.17, JSON.stringify({ missing, seen: first.seen }));
  near(missing.above, missing.below);
  near(first.view(844, 390).cy, 195);
  near(firstCamera({ ...meta, cameras: [] }).view(width, height).cy, height / 2);
  first.loosen(width, height);
  near(first.view(width, height).cy, view.cy, 1e-6);
  near(first.view(844, 390).cy, 195);
  // A camera that looks elsewhere gives no information about this view.
  const away = firstCamera({ ...meta, view: { position: [0, 1.6, 5.8], target: [0, 1.6, 20] } }).view(width, height);
  assert.ok(away.cy >= height / 4 && away.cy <= 3 * height / 4, `${away.cy}`);
  near(first.set({ position: [0, 0, 4] }).view(width, height).cy, height / 2);
  // What a single camera saw above the others does not count: its depth is unknown.
  const high = { ...meta.cameras[3], cy: 300 };
  const highest = more => firstCamera({ ...meta, cameras: [...meta.cameras, ...more] }).seen[0];
  assert.ok(highest([high, high]) < highest([high]) - 0.1, `${highest([high, high])} ${highest([high])}`);
});

test('a page without permission to edit loads no editor', options, async () => {
  const asked = [];
  const { page, done } = await open('', {});
  page.on('request', r => asked.push(r.url()));
  await page.reload();
  await page.waitForFunction(() => document.querySelector('splat-4d')?.player?.state === 'ready');
  assert.ok(asked.length > 10);
  assert.deepEqual(asked.filter(url => /\/edit/.test(url)), []);
  await done();
});

test('controls hide during playback and reappear; reduced motion does not autoplay', options, async () => {
  const moving = await open('', { config: { scene: 'scene.s4d', title: 'x' } });
  assert.equal(await moving.ask(e => e.paused), false, 'a page plays by itself');
  await moving.page.mouse.move(500, 200);
  await moving.page.waitForFunction(() => document.querySelector('splat-4d').shadowRoot.querySelector('.root.idle'));
  await moving.page.mouse.move(510, 210);
  assert.equal(await moving.ask(e => e.shadowRoot.querySelector('.root').classList.contains('idle')), false);
  await moving.done();
  const calm = await open('', { config: { scene: 'scene.s4d' }, reducedMotion: 'reduce' });
  assert.equal(await calm.ask(e => e.paused), true);
  await calm.page.keyboard.press('2');
  await settle(calm.page);
  assert.equal(await calm.ask(e => e.camera.position[0]), -4, 'cameras are cut to, not glided to');
  await calm.done();
});

test('a path is made, played, exported and read again; bullet time stops the clock', options, async () => {
  const { page, ask, done } = await open();
  const at = (camera, t) => ask((e, [camera, t]) => { e.camera = camera; e.seek(t); }, [camera, t]);
  await at({ position: [0, 1, 5], target: [0, 1, 0], fov: 40 }, 1);
  await page.keyboard.press('k');
  await at({ position: [5, 1, 0], target: [0, 1, 0], fov: 50 }, 1.5);
  await page.keyboard.press('k');
  await page.getByRole('button', { name: 'Cameras and paths' }).click();
  const saved = page.waitForEvent('download');
  await page.getByRole('button', { name: 'Export' }).click();
  const download = await saved;
  const chunks = [];
  for await (const chunk of await download.createReadStream()) chunks.push(chunk);
  const file = JSON.parse(Buffer.concat(chunks));
  assert.deepEqual(file.keys.map(k => [k.time, k.scene_time, k.position, k.look_at.map(Math.round), k.fov_y]),
    [[0, 1, [0, 1, 5], [0, 1, 0], 40], [0.5, 1.5, [5, 1, 0], [0, 1, 0], 50]]);
  const known = ['time', 'scene_time', 'position', 'look_at', 'up', 'fov_y'];
  assert.ok(Object.keys(file.keys[0]).every(k => known.includes(k)));
  const middle = await ask(e => {
    const { camera, sceneTime } = e.player.track.at(0.25);
    return [camera.position, camera.fov, sceneTime];
  });
  // Tangents of the ends are the chord's: in the middle the path is at the chord's middle.
  assert.deepEqual(middle, [[2.5, 1, 2.5], 45, 1.25]);
  const read = text => ask(async (e, text) => {
    const { Track } = await import('/player/track.js');
    try {
      return JSON.parse(JSON.stringify(Track.parse(text, e.player.camera)));
    } catch (error) { return error.message; }
  }, text);
  assert.deepEqual((await read(JSON.stringify(file))).keys, file.keys, 'what is written is read');
  const matrix = [[1, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 5], [0, 0, 0, 1]];
  const posed = (await read(JSON.stringify({ keys: [{ time: 0, world_to_camera: matrix }] }))).keys[0];
  assert.deepEqual(posed.position, [0, 1, 5]);
  assert.ok(posed.look_at[2] < 5 && Math.abs(posed.up[1] - 1) < 1e-6);
  for (const [text, reason] of [
    ['{"keys": []}', 'empty'], ['{', 'JSON'], ['{"keys": [{"time": 0}]}', 'world_to_camera'],
    ['{"keys": [{"time": 0, "lookat": 1}]}', 'lookat'],
    ['{"keys": [{"time": 0, "position": [0,0,1], "look_at": [0,0,1]}]}', 'the same point'],
    [JSON.stringify({ keys: [file.keys[0], file.keys[0]] }), 'not after']]) {
    assert.ok((await read(text)).includes(reason), `${text}: ${await read(text)}`);
  }
  await page.keyboard.press('Escape');
  await page.keyboard.press('p');
  // Both are read in one breath: the path lasts half a second, and may be over before a second query.
  const moment = await page.waitForFunction(() => {
    const e = document.querySelector('splat-4d');
    return e.currentTime > 1.2 && e.currentTime < 1.5 && [e.currentTime, e.camera.position[0]];
  });
  const [time, x] = await moment.jsonValue();
  assert.ok(x > 0.5, `camera and time move together: at ${time} s the camera is at ${x}`);
  await page.keyboard.press('p');
  await ask(e => e.seek(2));
  const from = await ask(e => e.camera.position);
  await page.keyboard.press('b');
  // A busy machine may draw its first image late.
  const moved = await page.waitForFunction(from => {
    const e = document.querySelector('splat-4d');
    return e.camera.position.some((x, k) => x !== from[k]) && [e.currentTime, !!e.player.film?.frozen];
  }, from);
  assert.deepEqual(await moved.jsonValue(), [2, true]);
  await page.keyboard.press('b');
  assert.equal(await ask(e => e.player.film), null);
  await done();
});

test('training is followed: late join, new snapshots, lost connections', options, async () => {
  const step = i => site.say({ kind: 'step', step: 10 * i, of: 500, psnr: 15 + i / 10, loss: 0.3 - i / 1000,
    gaussians: 9000 + i, left_s: 120 - i });
  site.history = [];
  site.pages['/scene.s4d'] = 'the bytes of a scene';
  for (let i = 1; i <= 20; i++) step(i);
  site.say({ kind: 'snapshot', version: 7 });
  const config = { title: 'learning', scene: 'scene.s4d', live: true, autoplay: false };
  const { page, ask, done } = await open('', { config, wrong: true });
  const card = page.getByRole('region', { name: 'Training' });
  await card.getByText('200of 500').waitFor();
  const text = await card.innerText();
  for (const part of ['Training', 'of 500 steps', '17.00', '9,020', '2 min left']) {
    assert.ok(text.includes(part), `${part} in ${text}`);
  }
  assert.match(await page.getByRole('img', { name: /PSNR from/ }).getAttribute('aria-label'), /from 15\.1 to 17\.0 dB/);
  const opened = () => page.evaluate(() => globalThis.mockOpened.map(u => new URL(u).search));
  for (const part of ['PSNR, training views, dB', 'Loss', '17.0', '15.1', '0.299', '0.280', '10', 'steps']) {
    assert.ok(text.includes(part), `the chart has ${part}: ${text}`);
  }
  assert.deepEqual(await opened(), ['?v=7'], 'one scene, the newest');
  await ask(e => { e.camera = { position: [2, 1, 3], target: [0, 1, 0] }; e.seek(3); });
  await settle(page);
  site.say({ kind: 'snapshot', version: 8 });
  await page.waitForFunction(() => globalThis.mockOpened.length === 2);
  await page.waitForTimeout(300);
  await page.waitForFunction(() => document.querySelector('splat-4d').player.state === 'ready');
  const kept = await ask(e => [e.camera.position, e.currentTime, e.player.state]);
  assert.deepEqual(kept, [[2, 1, 3], 3, 'ready'], 'camera and time stay');
  const joined = site.joined;
  site.cut();
  await card.getByText('Reconnecting').waitFor();
  step(21);
  await card.getByText('210of 500').waitFor({ timeout: 10000 });
  assert.ok(site.joined > joined, 'it came back by itself');
  site.say({ kind: 'step', step: 220, of: 500, psnr: 17, held_out: 16.5, loss: 0.28, gaussians: 9020, left_s: 100 });
  await card.getByText('held out', { exact: false }).first().waitFor();
  assert.ok(await card.evaluate(e => [...e.querySelectorAll('.figures > div')].every(d => d.getBoundingClientRect().right
    <= e.getBoundingClientRect().right)), 'four figures stay inside the card');
  assert.deepEqual(await opened(), ['?v=7', '?v=8'], 'what is known is not loaded again');
  step(50);
  site.say({ kind: 'done' });
  await card.getByText('Training finished').waitFor();
  await card.getByRole('button', { name: 'Save the scene' }).waitFor();
  assert.equal(await ask(e => e.player.file.name), 'bytes', 'the page has the scene itself');
  // The server may end now: the page requests nothing more.
  const [last, answered] = [site.joined, []];
  page.on('request', r => answered.push(r.url()));
  site.cut();
  await page.waitForTimeout(1200);
  assert.deepEqual([site.joined, answered], [last, []]);
  const [file] = await Promise.all([page.waitForEvent('download'), card.getByRole('button', { name: 'Save the scene' }).click()]);
  assert.equal(file.suggestedFilename(), 'scene.s4d');
  await done();
});

test('stored preferences, and the choice of a backend', options, async () => {
  const { page, ask, context, done } = await open('', { colorScheme: 'dark' });
  const page_ = () => ask(e => getComputedStyle(e.shadowRoot.querySelector('.root')).getPropertyValue('--page').trim());
  assert.equal(await page_(), '#0d0f12');
  await page.keyboard.press('t');
  assert.equal(await page_(), '#eef0f2');
  assert.match(await ask(e => e.statistics.fallback), /WebGPU: no adapter/);
  const again = await context.newPage();
  await again.goto(site.url);
  await again.waitForFunction(() => document.querySelector('splat-4d')?.player?.state === 'ready');
  assert.equal(await again.$eval('splat-4d', e => e.shadowRoot.querySelector('.root').dataset.theme), 'light');
  await done();
});

test('an eye of a headset renders the scene of the page from its own pose', options, async () => {
  const { ask, done } = await open();
  const [page, eye, right] = await ask(async e => {
    const { eyeView } = await import('/player/xr.js');
    const camera = e.player.camera.clone().set({ position: [1, 1, 4], target: [1, 1, 0], fov: 90 });
    const at = x => ({
      transform: { position: { x, y: 0, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } },
      // Field of view 90 degrees, square: as WebXR gives it, column by column.
      projectionMatrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, -1, 0, 0, -0.1, 0],
    });
    const plain = v => ({ ...v, cameraFromWorld: [...v.cameraFromWorld].map(x => +x.toFixed(9) + 0) });
    return [camera.view(200, 200), eyeView(at(0), camera, 0.5, 200, 200), eyeView(at(0.03), camera, 0.5, 200, 200)]
      .map(plain);
  });
  assert.deepEqual({ ...eye, fx: 0, fy: 0 }, { ...page, fx: 0, fy: 0 });
  near(eye.fx, page.fx, 1e-9);
  near(eye.fy, page.fy, 1e-9);
  // 3 cm to the right, where half a metre is a unit: 0.06 units.
  near(right.cameraFromWorld[3], eye.cameraFromWorld[3] - 0.06, 1e-9);
  await done();
});

// The sound of a scene follows its clock: after a start, seeks, loops and at other speeds, by the position of the
// audio element and by its samples. ffmpeg makes the sound; without it these tests are skipped. SECONDS: how long the
// first test listens, and SEEKS: how often it seeks (studies/records/2026-11-28-sound.md has a long run).

import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { launch, open } from './browser.mjs';
import { sample } from './sample.mjs';
import { PLAYER, serve } from './server.mjs';

const SECONDS = +(process.env.SECONDS ?? 4), SEEKS = +(process.env.SEEKS ?? 4);
/// The clip of these scenes, s: it does not begin at 0, and is longer than a test.
const CLIP = [2, 2 + 30 + 2 * SECONDS];
/// Largest difference of sound and clock, s, and how soon after a jump it holds, ms: a busy machine starts it three times.
const BOUND = 0.04, SETTLE = 2500;

const THREE = path.join(process.env.PLAYWRIGHT ?? '', 'node_modules/three/build/three.module.js');
const work = mkdtempSync(path.join(tmpdir(), 'splat4d-'));
const browser = await launch();
test.after(async () => {
  await browser?.close();
  rmSync(work, { recursive: true });
});

/// A click of 2 ms at every second of a quiet hum, as AAC in MP4; null without ffmpeg.
function clicks() {
  const file = path.join(work, 'clicks.m4a'), length = CLIP[1] - CLIP[0];
  const source = `aevalsrc='if(lt(mod(t,1),0.002),0.9,0.01*sin(600*t))':s=48000:d=${length}`;
  try {
    execFileSync('ffmpeg', ['-v', 'error', '-f', 'lavfi', '-i', source, '-c:a', 'aac', '-b:a', '64k', '-movflags', '+faststart', file]);
  } catch { return null; }
  return readFileSync(file);
}

const MP4 = browser && clicks();
const options = { skip: MP4 ? false : 'needs a browser and ffmpeg', timeout: 60000 + 4000 * (SECONDS + SEEKS) };

/// A scene of a few Gaussians with this sound from second `from` on.
const scene = (mp4 = MP4, { from = CLIP[0], codec = 0, ...more } = {}) =>
  sample({ scale: 0.02, json: { clip: CLIP }, patch: (sections) => {
    for (const s of sections) if (s.kind === 'PAGE') Object.assign(s, { from: CLIP[0], to: CLIP[1] + 0.1 });
    return [...sections, { kind: 'SOUN', data: mp4, codec, from, to: from + CLIP[1] - CLIP[0], ...more }];
  } }).bytes;

const HTML = `<!doctype html><link rel="icon" href="data:,"><script>
  // What the player plays, for the tests alone.
  globalThis.Audio = class extends Audio {
    constructor() { super(); (globalThis.heard ??= []).push(this); }
    // As browsers outside of tests do before the page is touched.
    play() { return globalThis.shy ? Promise.reject(new DOMException('', 'NotAllowedError')) : super.play(); }
  };
  if (location.hash === '#shy') {
    globalThis.shy = true;
    addEventListener('pointerup', () => { globalThis.shy = false; }, { capture: true });
  }
  </script><splat-4d src="/scene.s4d" ATTRIBUTES style="display:block;width:160px;height:120px;min-height:0"></splat-4d>
  <script type="module" src="/player/element.js"></script>`;

async function page(t, { bytes = scene(), attributes = '', delay = 0, hash = '' } = {}) {
  const server = await serve({ files: { 'page.html': HTML.replace('ATTRIBUTES', attributes), 'scene.s4d': bytes }, delay });
  const opened = await open(browser, `${server.url}page.html${hash}`, { viewport: { width: 400, height: 300 } });
  t.after(() => Promise.all([opened.page.close(), server.close()]));
  const ask = (f, arg) => opened.page.$eval('splat-4d', f, arg);
  return { ...opened, ask, server, sound: () => opened.page.waitForFunction(() => document.querySelector('splat-4d').player?.sound.there, null, { timeout: 30000 }) };
}

/// Differences of what is heard and the clock, s, each frame for `seconds`; those in the first `SETTLE` ms aside.
const listen = (ask, seconds, settle = SETTLE) => ask((e, [seconds, settle]) => new Promise((done) => {
  const out = [], begin = performance.now();
  const see = (frame) => {
    const now = performance.now(), { player } = e, heard = player.sound.time;
    if (now - begin > settle) out.push(heard === null ? null : heard - player.clock - (now - frame) / 1000 * player.speed);
    if (now - begin > settle + 1000 * seconds) return done(out);
    requestAnimationFrame(see);
  };
  requestAnimationFrame(see);
}), [seconds, settle]);

const within = (off, bound = BOUND) => {
  assert.ok(off.length > 3 && off.every((x) => x !== null), `it is heard all the time: ${off.length} frames, ${off.filter((x) => x === null).length} silent`);
  const worst = Math.max(...off.map(Math.abs));
  assert.ok(worst <= bound, `at most ${bound} s off, found ${worst.toFixed(4)}`);
  return worst;
};

test('sound follows the clock: after the start, seeks, a pause and a loop', options, async (t) => {
  const { page: p, ask, sound, errors } = await page(t, { attributes: 'resolution="0.1"' });
  await sound();
  await p.mouse.click(80, 60);
  await ask((e) => e.play());
  const first = await listen(ask, SECONDS), worst = [within(first)];
  t.diagnostic(`after the first and the last second: ${[first[0], first.at(-1)].map((x) => (1000 * x).toFixed(2)).join(', ')} ms`);
  for (let k = 0; k < SEEKS; k++) {
    // A repeatable walk over the clip.
    const to = CLIP[0] + ((k * 7.31) % (CLIP[1] - CLIP[0] - 4));
    await ask((e, to) => e.seek(to), to);
    worst.push(within(await listen(ask, 0.5)));
  }
  t.diagnostic(`worst difference: ${(1000 * worst[0]).toFixed(1)} ms in ${SECONDS} s, ${(1000 * Math.max(...worst.slice(1))).toFixed(1)} ms after ${SEEKS} seeks`);
  await ask((e) => e.pause());
  await p.waitForTimeout(100);
  assert.equal(await ask((e) => e.player.sound.time), null, 'a pause is silent');
  await ask((e, t) => { e.seek(t); e.play(); }, CLIP[1] - 1);
  await p.waitForFunction(([t]) => document.querySelector('splat-4d').player.clock < t, [CLIP[0] + 5], { timeout: 10000 });
  within(await listen(ask, 0.5));
  assert.deepEqual(errors, []);
});

test('samples are heard when the clock is where they belong', options, async (t) => {
  const { page: p, ask, sound } = await page(t);
  await sound();
  await p.mouse.click(80, 60);
  const off = await ask(async (e, first) => {
    const context = new AudioContext(), out = [];
    const tap = context.createScriptProcessor(256, 1, 1);
    context.createMediaElementSource(globalThis.heard.at(-1)).connect(tap);
    tap.connect(context.destination);
    let last = -1;
    tap.onaudioprocess = ({ inputBuffer, playbackTime }) => {
      const samples = inputBuffer.getChannelData(0), k = samples.findIndex((x) => Math.abs(x) > 0.4);
      const at = playbackTime + k / context.sampleRate;
      if (k < 0 || at - last < 0.3) return;
      last = at;
      // The context's clock at a moment of the page's, and the player's at the same.
      const now = performance.now();
      out.push({ at, now, context: context.currentTime, clock: e.player.clock, frame: out.frame });
    };
    const tick = (frame) => { out.frame = frame; if (!out.over) requestAnimationFrame(tick); };
    requestAnimationFrame(tick);
    e.play();
    await new Promise((done) => setTimeout(done, 5500));
    out.over = true;
    return out.slice(2).map(({ at, now, context, clock, frame }) => {
      // Where the clock was when the click left the context's graph; a click is at each whole second of the sound.
      const then = clock + (now - frame) / 1000 + (at - context) - first;
      return then - Math.round(then);
    });
  }, CLIP[0]);
  assert.ok(off.length >= 2, `${off.length} clicks`);
  t.diagnostic(`clicks: ${off.map((x) => (1000 * x).toFixed(1)).join(', ')} ms off`);
  // The graph adds blocks of the context and of the tap; a wrong encoder delay, or a wrong start, would be more.
  assert.ok(off.every((x) => Math.abs(x) <= 0.06), `${off}`);
});

test('sound is stretched at half and double speed and silent beyond', options, async (t) => {
  const { page: p, ask, sound } = await page(t);
  await sound();
  await p.mouse.click(80, 60);
  await ask((e) => e.play());
  for (const speed of [0.5, 2]) {
    await ask((e, x) => e.setAttribute('speed', x), speed);
    within(await listen(ask, 0.5), BOUND * speed);
    assert.ok(await ask(() => globalThis.heard.at(-1).preservesPitch));
  }
  for (const speed of [0.25, 4]) {
    await ask((e, x) => e.setAttribute('speed', x), speed);
    assert.ok((await listen(ask, 0.3, 300)).every((x) => x === null), 'silent');
  }
});

test('sound is loaded after the first image, once, and its control has a name', options, async (t) => {
  const bytes = scene();
  const { page: p, ask, sound, server, errors } = await page(t, { bytes, attributes: 'muted', delay: 20 });
  await p.waitForFunction(() => document.querySelector('splat-4d').statistics?.firstFrame > 0, null, { timeout: 30000 });
  const requests = () => server.log.filter((r) => r.url === '/scene.s4d' && r.to >= bytes.length - 1);
  const early = await ask((e) => e.player.state === 'ready' && !e.player.sound.there);
  await sound();
  assert.equal(requests().length, 1);
  assert.ok(early || requests()[0].to === bytes.length - 1);
  const tool = () => ask((e) => { const { soundTool } = e.face; return [soundTool.hidden, soundTool.getAttribute('aria-label')]; });
  assert.deepEqual(await tool(), [false, 'Sound on']);
  assert.deepEqual(await ask((e) => [e.muted, e.volume, globalThis.heard.at(-1).muted]), [true, 1, true]);
  const told = ask((e) => new Promise((done) => e.addEventListener('volumechange', () => done(e.muted), { once: true })));
  await ask((e) => { e.muted = false; });
  assert.equal(await told, false);
  await ask((e) => { e.volume = 0.25; });
  assert.deepEqual([await tool(), await ask(() => globalThis.heard.at(-1).volume)], [[false, 'Mute'], 0.25]);
  await p.focus('splat-4d');
  await ask((e) => e.player.stage.focus());
  await p.keyboard.press('u');
  assert.equal(await ask((e) => e.muted), true);
  assert.deepEqual(errors, []);
});

test('the object of three.js plays the sound with its clock', { ...options, skip: options.skip || (!existsSync(THREE) && 'needs three.js') }, async (t) => {
  const folders = { '/npm/player/': PLAYER, '/npm/': fileURLToPath(new URL('../../npm/', import.meta.url)), '/three/': path.dirname(THREE) + '/' };
  const html = `<!doctype html><link rel="icon" href="data:,"><script type="importmap">
    {"imports":{"splat4d/three":"/npm/three.js","three":"/three/three.module.js"}}</script><script type="module">
    import * as THREE from 'three';
    import { Splat4D } from 'splat4d/three';
    const renderer = new THREE.WebGLRenderer(), scene = new THREE.Scene();
    document.body.append(renderer.domElement);
    renderer.setSize(80, 60);
    const camera = new THREE.PerspectiveCamera(45, 4 / 3, 0.1, 50), object = globalThis.object = new Splat4D('/scene.s4d', { sound: true });
    camera.position.z = 4;
    scene.add(object);
    renderer.setAnimationLoop(() => renderer.render(scene, camera));
    object.play();
  </script>`;
  const server = await serve({ files: { 'page.html': html, 'scene.s4d': scene() }, folders });
  const { page: p, errors } = await open(browser, `${server.url}page.html`, { viewport: { width: 200, height: 150 } });
  t.after(() => Promise.all([p.close(), server.close()]));
  await p.waitForFunction(() => globalThis.object?.sound?.time, null, { timeout: 30000 });
  await p.mouse.click(40, 30);
  await p.waitForTimeout(1500);
  const off = await p.evaluate(() => object.sound.time - object.time);
  // The clock is that of the last frame, on a busy machine some time ago.
  assert.ok(Math.abs(off) < 0.15, `${off}`);
  await p.evaluate(() => { object.sound.muted = true; object.pause(); });
  await p.waitForTimeout(300);
  assert.equal(await p.evaluate(() => object.sound.time), null);
  await p.evaluate(() => object.dispose());
  assert.deepEqual(errors, []);
});

test('where the browser refuses sound, the first touch starts it', options, async (t) => {
  const { page: p, ask, sound } = await page(t, { attributes: 'autoplay', hash: '#shy' });
  await sound();
  await p.waitForTimeout(300);
  assert.equal(await ask((e) => e.player.sound.blocked), true, 'no gesture yet');
  assert.match(await ask((e) => e.face.soundTool.getAttribute('aria-label')), /waits for a click/);
  await p.mouse.click(80, 60);
  within(await listen(ask, 0.5));
});

test('damaged and foreign sound leaves the scene as it is', options, async (t) => {
  const flip = (bytes) => { const b = Buffer.from(bytes); b[b.length - 1] ^= 1; return b; };
  const junk = Buffer.concat([Buffer.from([0, 0, 0, 8]), Buffer.from('ftyp'), Buffer.alloc(4000, 7)]);
  for (const bytes of [flip(scene()), scene(Buffer.from('not sound at all')), scene(junk)]) {
    const { page: p, ask } = await page(t, { bytes, attributes: 'autoplay' });
    await p.waitForFunction(() => document.querySelector('splat-4d').player?.state === 'ready', null, { timeout: 30000 });
    await p.waitForTimeout(500);
    assert.deepEqual(await ask((e) => [e.player.state, e.player.sound.there, e.paused]), ['ready', false, false]);
  }
  for (const wrong of [{ codec: 1 }, { patch: (e) => e.writeDoubleLE(NaN, 40) }]) {
    const { page: p, ask } = await page(t, { bytes: scene(MP4, wrong) });
    await p.waitForFunction(() => document.querySelector('splat-4d').player?.state === 'error', null, { timeout: 30000 });
    assert.match(await ask((e) => e.face.notice.textContent), /SOUN/);
  }
});

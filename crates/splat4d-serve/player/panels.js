// The two panels over the bar (View, Cameras), the help page and the figures.

import { CHANNELS } from './player.js';
import { clockOf } from './camera.js';
import { Track } from './track.js';
import { allow, button, bytes, choice, clock, field, h, pick, save, segments, tool } from './dom.js';

export const CHANNEL_NAMES = { color: 'Colour', depth: 'Depth', alpha: 'Alpha', flow: 'Flow' };
export const SPEEDS = [0.1, 0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4];
const SCALES = [['auto', 'Automatic'], [1, 'Full'], [0.75, '75 %'], [0.5, '50 %'], [0.25, '25 %']];
const BACKENDS = [['auto', 'Automatic'], ['webgpu', 'WebGPU'], ['webgl2', 'WebGL2']];
/** Title of the controls of time in a scene without one. */
const STATIC = 'The scene is static';
const BACKGROUNDS = { scene: null, black: [0, 0, 0], grey: [0.5, 0.5, 0.5], white: [1, 1, 1] };

const KEYS = [
  ['Play or pause', 'Space'], ['Seek', '←', '→'], ['One frame', ',', '.'], ['Start, end', 'Home', 'End'],
  ['Slower, faster', '[', ']'], ['Loop', 'L'], ['Sound', 'U'], ['Channel', 'C'], ['Cameras', '1', '…', '9'],
  ['Next camera', 'N'], ['Reset the view', 'R'], ['Orbit or fly', 'M'], ['Move', 'W', 'A', 'S', 'D'],
  ['Down, up', 'Q', 'E'], ['Move faster', 'Shift'], ['Turn', 'Shift + arrows'], ['Zoom', '↑', '↓'],
  ['Add a camera key', 'K'], ['Play the camera path', 'P'], ['Bullet time', 'B'], ['Full screen', 'F'], ['Statistics', 'I'],
  ['Cameras in the scene', 'V'], ['Image next to the render', 'Z'],
  ['Save image', 'G'], ['Light or dark', 'T'], ['This help', 'H', '?'],
];
const GESTURES = [
  ['Drag', 'Turn'], ['Right drag, two fingers', 'Move'], ['Wheel, pinch', 'Zoom'],
  ['Alt + wheel', 'Field of view'],
];

function panel(title, close, ...children) {
  const node = h('section', { class: 'card panel', role: 'dialog', 'aria-label': title, hidden: true },
    h('div', { class: 'head' }, h('h2', {}, title), tool('close', 'Close', close)), ...children);
  return node;
}

export function viewPanel(ui) {
  const { player } = ui;
  const channel = segments('Channel', CHANNELS.map(c => [c, CHANNEL_NAMES[c]]), c => player.setChannel(c));
  const speed = choice('Speed', SPEEDS.map(s => [s, `${s}×`]), s => { player.speed = +s; });
  const loop = h('input', { type: 'checkbox', 'aria-label': 'Loop', onchange: () => ui.setLoop(loop.checked) });
  const scale = choice('Resolution', SCALES, s => ui.setResolution(s));
  const backend = choice('Renderer', BACKENDS, b => player.useBackend(b));
  const ground = choice('Background', Object.keys(BACKGROUNDS).map(b => [b, b[0].toUpperCase() + b.slice(1)]), b => {
    player.background = BACKGROUNDS[b];
    player.redraw();
  });
  const OFF = '-';
  let named = null;
  const labels = choice('Labels', [], v => player.setLabels({
    colors: v === OFF + OFF, only: v.startsWith(OFF) ? null : player.meta.labels[+v],
  }));
  const labelsField = field('Labels', labels);
  const rung = choice('Bit rate', [], k => { player.rung = k; });
  const rungField = field('Bit rate', rung);
  let rungs = null;
  const theme = segments('Theme', [['auto', 'Auto'], ['light', 'Light'], ['dark', 'Dark']], t => ui.setTheme(t));
  const figures = h('input', { type: 'checkbox', 'aria-label': 'Statistics',
    onchange: () => ui.setFigures(figures.checked) });
  const path = h('div', { class: 'wrap narrow' },
    button('Back', () => player.step(-1), { 'aria-label': 'One frame back' }, 'back'),
    button('Next', () => player.step(1), { 'aria-label': 'One frame forward' }, 'next'),
    button('Keys', () => ui.toggleHelp(), {}, 'help'));
  const node = panel('View', () => ui.open(null),
    h('div', { class: 'field cramped' }, channel),
    path,
    field('Speed', speed, 'narrow'), field('Loop', loop, 'narrow'), field('Resolution', scale),
    rungField, labelsField, field('Background', ground), field('Theme', theme), field('Renderer', backend), field('Statistics', figures),
    h('div', { class: 'wrap' },
      button('Save image', () => ui.screenshot(), {}, 'photo'),
      ui.page ? button('Copy link', () => ui.copyLink(), {}, 'link') : null,
      ui.page ? button('Open file', () => ui.pickFile(), {}, 'open') : null));
  node.refresh = () => {
    channel.set(player.channel);
    speed.set(player.speed, `${+player.speed.toFixed(2)}×`);
    loop.checked = player.loop;
    scale.set(player.resolution);
    backend.set(player.backendName);
    const now = JSON.stringify(player.background);
    ground.set(Object.keys(BACKGROUNDS).find(k => JSON.stringify(BACKGROUNDS[k]) === now));
    const names = player.meta?.labels ?? [];
    if (named !== names) {
      named = names;
      labels.replaceChildren(h('option', { value: OFF }, 'Not shown'), h('option', { value: OFF + OFF }, 'As colours'),
        ...names.map((name, i) => h('option', { value: i }, `Only ${name}`)));
    }
    labelsField.hidden = !names.length;
    labels.value = player.labels.only !== null ? String(player.labels.only) : player.labels.colors ? OFF + OFF : OFF;
    const steps = player.meta?.ladder ?? [];
    if (rungs !== steps) {
      rungs = steps;
      rung.replaceChildren(h('option', { value: 'auto' }, 'Automatic'),
        ...steps.map(({ rate }, k) => h('option', { value: k + 1 }, `${megabits(rate)}${k + 1 === steps.length ? ' (whole)' : ''}`)));
    }
    rungField.hidden = steps.length < 2;
    rung.value = String(player.rung);
    theme.set(ui.theme);
    figures.checked = ui.figuresOn;
    for (const item of [path.children[0], path.children[1], speed, loop]) {
      item.disabled = player.still;
      // Every file begins static, until its clip is known.
      if (player.still) item.title = STATIC;
      else if (item.title === STATIC) item.title = '';
    }
  };
  return node;
}

export function cameraPanel(ui) {
  const { player } = ui;
  const mode = segments('Movement', [['orbit', 'Orbit'], ['fly', 'Fly']], m => player.setMode(m));
  const list = choice('Camera of the capture', [], i => player.view(+i));
  const views = h('div', { class: 'field' }, list, h('div', { class: 'row' },
    tool('back', 'Previous camera', () => player.view((player.viewed ?? 0) - 1)),
    tool('next', 'Next camera', () => player.view((player.viewed ?? -1) + 1))));
  const keys = h('ol', { class: 'keys', 'aria-label': 'Keys of the path' });
  const note = h('p', { class: 'note' },
    'A key stores the camera and the time. Two or more keys make a path.');
  const play = button('Play path', () => ui.playPath(), {}, 'play');
  const bullet = button('Bullet time', () => ui.bullet(), { title: 'Stop the time and move the camera' });
  const out = button('Export', () => save(new Blob([JSON.stringify(player.track, null, 1)],
    { type: 'application/json' }), 'path.json'), { title: 'Save the path for splat4d render --path path.json' });
  const frusta = h('input', { type: 'checkbox', 'aria-label': 'Show cameras in the scene (V)', onchange: () => ui.showCameras(frusta.checked) });
  const photo = h('input', { type: 'checkbox', 'aria-label': 'Image next to the render (Z)', onchange: () => ui.compare(photo.checked) });
  const frustaField = field('Show cameras in the scene', frusta), photoField = field('Image next to the render', photo);
  const views3 = h('h3', {}, 'Cameras of the capture');
  const node = panel('Cameras', () => ui.open(null),
    field('Movement', mode),
    button('Reset the view', () => player.reset()),
    views3, views, frustaField, photoField,
    h('h3', {}, 'Camera path'), note, keys,
    h('div', { class: 'wrap' },
      button('Add key', () => ui.addKey()), play, bullet, out,
      button('Import', () => pick('.json,application/json', file => ui.importPath(file)))));
  let shown = null;
  node.refresh = () => {
    mode.set(player.controls.mode);
    const cameras = player.meta?.cameras ?? [];
    frusta.checked = !!ui.rig?.shown;
    photo.checked = !!ui.rig?.compared;
    frustaField.hidden = !cameras.length;
    photoField.hidden = !cameras.length || !ui.capture?.photos;
    if (shown !== cameras) {
      shown = cameras;
      list.replaceChildren(h('option', { value: -1, disabled: true }, 'Free view'),
        ...cameras.map((c, i) => h('option', { value: i }, [i + 1, c.name ?? 'camera', clockOf(c), c.held ? 'held out' : null]
          .filter(Boolean).join(' · '))));
      views.hidden = views3.hidden = !cameras.length;
    }
    list.value = String(player.viewed ?? -1);
    const n = player.track.keys.length;
    allow(play, n < 2 && !player.film && 'A path needs two keys');
    play.lastChild.textContent = player.film && !player.film.frozen ? 'Stop path' : 'Play path';
    bullet.lastChild.textContent = player.film?.frozen ? 'Stop bullet time' : 'Bullet time';
    allow(out, !n && 'No key to export', 'Save the path for splat4d render --path path.json');
    note.hidden = n > 1;
    keys.hidden = !n;
    if (!keys.contains(ui.focused())) keys.replaceChildren(...player.track.keys.map((key, i) => pathKey(ui, key, i)));
  };
  return node;
}

function pathKey(ui, key, i) {
  const { player } = ui;
  const seconds = h('input', { type: 'number', step: 0.1, value: +key.time.toFixed(2),
    'aria-label': `Key ${i + 1}, time in the path, seconds`,
    onchange: () => { player.track.move(i, +seconds.value); seconds.value = +key.time.toFixed(2); } });
  const scene = key.sceneTime === null ? '' : ` · scene ${clock(key.sceneTime - player.first)}`;
  return h('li', {}, h('b', {}, `${i + 1}`), seconds, h('span', {}, `s${scene}`),
    button('Go', () => ui.goTo(key), { 'aria-label': `Go to key ${i + 1}` }),
    tool('bin', `Delete key ${i + 1}`, () => { player.track.keys.splice(i, 1); ui.refresh(); }));
}

export function helpPage(close) {
  return h('div', { class: 'centre veil', hidden: true, onclick: e => e.target === e.currentTarget && close() },
    h('section', { class: 'card help', role: 'dialog', 'aria-modal': 'true', 'aria-label': 'Keys and gestures' },
      h('div', { class: 'head' }, h('h2', {}, 'Keys and gestures'), tool('close', 'Close help', close)),
      h('dl', {}, ...KEYS.map(([what, ...keys]) => h('div', { class: 'pair' }, h('dt', {}, what),
        h('dd', {}, ...keys.map(k => (k === '…' ? ' … ' : h('kbd', {}, k)))))),
      ...GESTURES.map(([what, does]) => h('div', { class: 'pair' }, h('dt', {}, what), h('dd', {}, does))))));
}

/** A bit rate in words. */
export const megabits = rate => `${+(rate / 1e6).toPrecision(3)} Mbit/s`;

/** Why a rung is the one that is rendered. */
const REASONS = { start: 'start', connection: 'connection', device: 'device', pinned: 'set', whole: 'whole' };

/** The figures card; refresh() reads the player's statistics. */
export function figuresCard(player) {
  const node = h('dl', { class: 'card stats', hidden: true, 'aria-label': 'Statistics' });
  const count = n => (n ?? 0).toLocaleString('en-GB');
  node.refresh = () => {
    const s = player.statistics;
    const rows = [
      ['Frames/s', s.atRest ? 'at rest' : s.fps ? s.fps.toFixed(0) : '–'],
      ['Frame', s.frameMs ? `${s.frameMs.toFixed(1)} ms` : '–'],
      ['Sorting', s.sortMs ? `${s.sortMs.toFixed(1)} ms` : '–'],
      ['Image', `${s.width} × ${s.height}`], ['Scale', `${Math.round(100 * s.scale)} %`],
      ['Rendered', count(s.drawn)], ...(s.foveated ? [['Left out at the edges', count(s.foveated)]] : []), ['Active', count(s.active)], ['Resident', count(s.resident)],
      ...(s.ladder ? [['Bit rate', `rung ${s.ladder.rung} of ${s.ladder.rungs} (${REASONS[s.ladder.reason]})`],
        ['Left out', count(s.ladder.leftOut)]] : []),
      ...(isFinite(s.megabits) && s.megabits ? [['Connection', `${s.megabits.toFixed(1)} Mbit/s`]] : []),
      ...(s.leftOut ? [['Left out', count(s.leftOut)]] : []), ['Gaussians', count(s.gaussians)], ['Read', `${bytes(s.bytesRead)} of ${bytes(s.bytesTotal)}`],
      ['First image', s.firstFrame ? `${s.firstFrame.toFixed(0)} ms` : '–'],
      ['Renderer', s.backend === 'webgpu' ? 'WebGPU' : s.backend === 'webgl2' ? 'WebGL2' : s.backend ?? '–'],
    ];
    node.replaceChildren(...rows.flatMap(([k, v]) => [h('dt', {}, k), h('dd', {}, v)]));
  };
  return node;
}

/** Reads a path file; the message states what is wrong with it. */
export async function readPath(file, camera) {
  return Track.parse(await file.text(), camera);
}

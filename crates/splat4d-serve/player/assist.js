// Manual alignment: the same points are clicked in the images of several cameras. The program solves after every click
// (`POST ./assist`) and saves the points; this page only shows images, marks and lines.

import { h, leave, shown } from './dom.js';
import { View } from './assist-view.js';

const { cameras } = await (await fetch('./config.json')).json();
const token = leave('assist');
async function ask(body) {
  const answer = await fetch('./assist', { method: 'POST', body: JSON.stringify(body),
    headers: { 'content-type': 'application/json', 'x-splat4d-token': token ?? '' } });
  const text = await answer.text();
  let value = null;
  try { value = JSON.parse(text); } catch { /* An error of the server is plain text. */ }
  if (!answer.ok) throw new Error(value?.error ?? text);
  return value;
}
const saved = await ask({ load: true }).catch(error => {
  document.body.append(h('p', { role: 'alert' }, error.message));
  throw error;
});
/** The program refuses points of a page that did not see the newest ones. */
let { revision } = saved;
const sizes = Object.fromEntries(cameras.map(c => [c.name, [c.width, c.height]]));
/** Steps that can be undone. */
const HISTORY = 200;
/** Images that are kept. */
const KEPT = 60;
/** Distances that are marked as bad, of the larger side: 8 px of 1920. */
const BAD = 0.004;
const COLORS = ['#58d0be', '#ffb454', '#8ab4ff', '#ff8fa3', '#c7e36b', '#d59bff', '#ffe27a', '#7fe0ff'];

const blank = { version: 1, cameras: sizes, event: {}, points: [], floor: [], length: null };
/** As the file has it, with every entry there. */
let clicks = { ...blank, ...saved.clicks, cameras: { ...saved.clicks.cameras, ...sizes } };
// Points of images of another size.
for (const point of clicks.points) {
  for (const click of point.clicks) {
    const [w, h] = saved.clicks.cameras[click.camera], [width, height] = sizes[click.camera];
    click.x *= width / w;
    click.y *= height / h;
  }
}
const past = [], future = [];
let found = null, active = null, finished = false;

const interval = c => (c.times.length > 1 ? (c.times.at(-1) - c.times[0]) / (c.times.length - 1) : 1 / 30);
const frame = Math.min(...cameras.map(interval));

/** Seconds that are added to a camera's clock. */
function offset(k) {
  const solved = found?.cameras[k].offset;
  if (solved != null) return solved;
  const marked = clicks.event[cameras[k].name], first = cameras.map(c => clicks.event[c.name]).find(t => t != null);
  if (marked != null && Object.keys(clicks.event).length > 1) return first - marked;
  return cameras[k].offset ?? 0;
}
/** The second of the common clock that is shown, and the frames of cameras that were stepped alone. */
let now = 0;
const alone = cameras.map(() => null);
function frameOf(k) {
  const { times } = cameras[k], time = now - offset(k);
  if (alone[k] != null) return alone[k];
  return times.reduce((best, t, i) => (Math.abs(t - time) < Math.abs(times[best] - time) ? i : best), 0);
}

// ---- What was clicked.

const names = () => [...new Set(clicks.points.map(p => p.name))];
const moves = name => clicks.points.some(p => p.name === name && p.moment != null) || waiting.get(name) === true;
/** New points without a click yet: name and whether they move. */
const waiting = new Map();
/** The entry of a point at the time that is shown. */
const entry = name => clicks.points.find(p => p.name === name
  && (p.moment == null || Math.abs(p.moment - now) < 0.25 * frame));

function change(act) {
  past.push(structuredClone(clicks));
  if (past.length > HISTORY) past.shift();
  future.length = 0;
  act();
  clicks.points = clicks.points.filter(p => p.clicks.length);
  const still = new Set(clicks.points.filter(p => p.moment == null).map(p => p.name));
  clicks.floor = clicks.floor.filter(name => still.has(name));
  if (clicks.length && !clicks.length.points.every(name => still.has(name))) clicks.length = null;
  solve();
}

function put(k, [x, y]) {
  if (finished) return;
  if (!active) begin(false);
  const name = active, moving = moves(name), round = v => Math.round(v * 100) / 100;
  change(() => {
    let point = entry(name);
    if (!point) {
      point = moving ? { name, moment: now, clicks: [] } : { name, clicks: [] };
      clicks.points.push(point);
      waiting.delete(name);
    }
    point.clicks = point.clicks.filter(c => c.camera !== cameras[k].name);
    point.clicks.push({ camera: cameras[k].name, x: round(x), y: round(y), time: cameras[k].times[frameOf(k)] });
  });
}

/** A new point. */
function begin(moving) {
  let number = 1;
  const used = new Set([...names(), ...waiting.keys()]);
  while (used.has(`${moving ? 'moving' : 'point'} ${number}`)) number += 1;
  active = `${moving ? 'moving' : 'point'} ${number}`;
  waiting.set(active, moving);
  render();
}

// ---- The program.

let busy = false, again = false;
/** The file leaves out what is empty. */
const sent = () => ({ ...clicks, length: clicks.length ?? undefined });
async function solve() {
  render();
  document.body.dataset.idle = 'false';
  if (busy) { again = true; return; }
  busy = true;
  try {
    do {
      again = false;
      found = await ask({ clicks: sent(), revision });
      ({ revision } = found);
      say('');
      render();
    } while (again);
  } catch (error) { say(error.message, true); }
  busy = false;
  document.body.dataset.idle = 'true';
}
async function finish() {
  finishing.disabled = true;
  try {
    const { file } = await ask({ clicks: sent(), revision, finish: true });
    finished = true;
    say(`Finished. The import continues in the terminal. The points are in ${file}.`);
  } catch (error) { say(error.message, true); }
  render();
}

// ---- The page.

const status = h('output', { role: 'status' }), alert = h('p', { role: 'alert' });
const say = (text, bad = false) => {
  alert.textContent = shown(text);
  alert.setAttribute('role', bad ? 'alert' : 'status');
};
const button = (text, onclick, props = {}) => h('button', { type: 'button', onclick, ...props }, text);
const slider = h('input', { type: 'range', 'aria-label': 'Time', oninput: () => seek(Number(slider.value)) });
const clock = h('output', {});
const finishing = button('Finish', finish, { class: 'main' });
const undoing = button('Undo', () => undo(past, future)), redoing = button('Redo', () => undo(future, past));
function undo(from, to) {
  if (!from.length || finished) return;
  to.push(clicks);
  clicks = from.pop();
  solve();
}

/** Times of the first camera on the common clock. */
const ticks = () => cameras[0].times.map(t => t + offset(0));
function seek(index) {
  now = ticks()[Math.min(cameras[0].times.length - 1, Math.max(0, index))];
  alone.fill(null);
  render();
}
const step = by => seek(Number(slider.value) + by);
slider.max = cameras[0].times.length - 1;
slider.value = 0;

const images = new Map();
function image(k, index) {
  const key = `${k} ${index}`;
  if (!images.has(key)) {
    const node = new Image();
    node.src = `./photo?view=${k}&t=${cameras[k].times[index]}`;
    images.set(key, node.decode().then(() => node, () => null));
    if (images.size > KEPT) images.delete(images.keys().next().value);
  }
  return images.get(key);
}

const color = name => COLORS[Math.max(0, [...names(), ...waiting.keys()].indexOf(name)) % COLORS.length];
const panels = cameras.map((camera, k) => {
  const canvas = h('canvas', { tabindex: 0, 'aria-label': `Image of ${camera.name}` });
  const view = new View(canvas, camera.width, camera.height, {
    onput: pixel => put(k, pixel),
    mark: () => {
      const click = active && entry(active)?.clicks.find(c => c.camera === camera.name);
      return click ? [click.x, click.y] : null;
    },
    paint: (v, c) => paint(k, v, c),
  });
  const state = h('span', { class: 'state' }), time = h('output', {});
  const event = button('Event', () => mark(k), { title: 'The frame shows the event by which cameras are synchronised' });
  const single = by => {
    alone[k] = Math.min(camera.times.length - 1, Math.max(0, frameOf(k) + by));
    render();
  };
  const node = h('section', { class: 'camera', 'aria-label': camera.name },
    h('div', {}, h('strong', {}, camera.name), state, event,
      button('◀', () => single(-1), { 'aria-label': `Previous frame of ${camera.name}` }), time,
      button('▶', () => single(1), { 'aria-label': `Next frame of ${camera.name}` })), canvas);
  return { node, view, state, time, event };
});

/** The frame that a camera shows is that of the event; a second press takes it away. */
function mark(k) {
  const { name, times } = cameras[k], time = times[frameOf(k)];
  change(() => {
    if (clicks.event[name] === time) delete clicks.event[name];
    else clicks.event[name] = time;
  });
}

function paint(k, view, c) {
  const { name, width, height } = cameras[k], dash = on => c.setLineDash(on ? [5, 4] : []);
  const outline = (draw, tint) => {
    for (const [style, size] of [['rgba(0,0,0,.7)', 4], [tint, 1.7]]) {
      Object.assign(c, { strokeStyle: style, lineWidth: size });
      draw();
      c.stroke();
    }
  };
  const line = (...points) => () => {
    c.beginPath();
    points.map(p => view.place(p)).forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
  };
  const current = active && entry(active);
  clicks.points.forEach((point, p) => {
    const shownNow = point.moment == null || Math.abs(point.moment - now) < 0.25 * frame;
    const click = point.clicks.find(x => x.camera === name), tint = color(point.name), solved = found?.points[p];
    if (!shownNow) {
      if (click && point.name === active) {
        c.fillStyle = tint;
        const [x, y] = view.place([click.x, click.y]);
        c.fillRect(x - 1.5, y - 1.5, 3, 3);
      }
      return;
    }
    const isActive = point === current;
    if (isActive && solved) {
      for (const [from, { lines }] of Object.entries(solved.clicks)) {
        const points = lines[name];
        if (from === name || !points || points.length < 2) continue;
        dash(true);
        outline(line(...points), tint);
        dash(false);
      }
    }
    const seen = solved?.seen[name];
    if (seen) {
      const [x, y] = view.place(seen);
      outline(() => { c.beginPath(); c.arc(x, y, 6, 0, 7); }, tint);
    }
    if (!click) return;
    const at = isActive && view.held ? view.held : [click.x, click.y], [x, y] = view.place(at);
    if (seen) outline(line(at, seen), tint);
    const arm = isActive ? 11 : 7;
    outline(() => {
      c.beginPath();
      c.moveTo(x - arm, y);
      c.lineTo(x + arm, y);
      c.moveTo(x, y - arm);
      c.lineTo(x, y + arm);
    }, tint);
    const off = solved?.clicks[name]?.off;
    const bad = off != null && off > BAD * Math.max(width, height);
    if (!isActive && !bad) return;
    const text = `${shown(point.name)}${off == null ? '' : ` ${off.toFixed(1)} px`}`;
    c.font = '12px system-ui, sans-serif';
    Object.assign(c, { lineWidth: 3, strokeStyle: 'rgba(0,0,0,.75)', fillStyle: bad ? '#ff9f8f' : '#fff' });
    c.strokeText(text, x + 9, y - 7);
    c.fillText(text, x + 9, y - 7);
  });
}

const list = h('ul', { 'aria-label': 'Points' }), lengths = h('div', {});
const newStill = button('New point', () => begin(false)), newMoving = button('New moving point', () => begin(true));

/** Largest distance of a point's clicks, pixels. */
function worst(name) {
  let most = null;
  clicks.points.forEach((point, p) => {
    if (point.name !== name) return;
    Object.values(found?.points[p]?.clicks ?? {}).forEach(({ off }) => { if (off != null) most = Math.max(most ?? 0, off); });
  });
  return most;
}

function rename(name, to) {
  if (!to || to === name || names().includes(to)) return render();
  change(() => {
    clicks.points.filter(p => p.name === name).forEach(p => { p.name = to; });
    clicks.floor = clicks.floor.map(n => (n === name ? to : n));
    if (clicks.length) clicks.length.points = clicks.length.points.map(n => (n === name ? to : n));
    active = to;
  });
}

function row(name) {
  const moving = moves(name), off = worst(name), side = Math.max(...cameras.flatMap(c => [c.width, c.height]));
  const count = clicks.points.filter(p => p.name === name).reduce((n, p) => n + p.clicks.length, 0);
  const pickOne = () => {
    active = name;
    const own = clicks.points.find(p => p.name === name && p.moment != null);
    if (own && !entry(name)) {
      const all = ticks();
      slider.value = all.reduce((best, t, i) => (Math.abs(t - own.moment) < Math.abs(all[best] - own.moment) ? i : best), 0);
      now = own.moment;
      alone.fill(null);
    }
    render();
  };
  const floor = h('input', { type: 'checkbox', checked: clicks.floor.includes(name), 'aria-label': `${name} is on the floor`,
    onchange: () => change(() => {
      clicks.floor = floor.checked ? [...clicks.floor, name] : clicks.floor.filter(n => n !== name);
    }) });
  const radio = h('input', { type: 'radio', name: 'active', checked: active === name, onchange: pickOne, 'aria-label': name });
  const swatch = h('span', { style: `width:.8em;height:.8em;border-radius:50%;flex:none;background:${color(name)}` });
  return h('li', { class: `${active === name ? 'active' : ''} ${off > BAD * side ? 'bad' : ''}` }, radio, swatch,
    h('label', { onclick: pickOne, ondblclick: () => rename(name, prompt('Name of the point', name)?.trim()), title: 'Double-click: rename' },
      moving ? `${name} (moves)` : name),
    h('output', {}, `${count} clicks${off == null ? '' : `, ${off.toFixed(1)} px`}`),
    moving ? null : floor,
    button('✕', () => change(() => {
      clicks.points = clicks.points.filter(p => p.name !== name);
      waiting.delete(name);
      if (active === name) active = null;
    }), { 'aria-label': `Remove ${name}` }));
}

/** Points that were chosen before their distance was entered. */
let pair = null;
function lengthRow() {
  const still = names().filter(name => !moves(name));
  if (still.length < 2) return h('p', {}, 'Click two points first.');
  if (!pair?.every(name => still.includes(name))) pair = null;
  const metres = clicks.length?.metres ?? '', [a, b] = clicks.length?.points ?? pair ?? still;
  const choose = (value, label) => h('select', { 'aria-label': label, onchange: update },
    ...still.map(name => h('option', { value: name, selected: name === value }, name)));
  const one = choose(a, 'From point'), two = choose(b, 'To point');
  const value = h('input', { type: 'number', min: 0, step: 'any', value: metres, 'aria-label': 'Metres', onchange: update });
  function update() {
    const length = Number(value.value);
    pair = [one.value, two.value];
    if (!value.value && !clicks.length) return;
    if (value.value && !(length > 0 && one.value !== two.value)) { say('Choose two points and more than 0 metres.', true); return; }
    change(() => { clicks.length = value.value ? { points: pair, metres: length } : null; });
  }
  return h('div', { class: 'length' }, one, ' to ', two, ' ', value, ' m');
}

function summary() {
  const placed = found ? found.cameras.filter(c => !c.missing).length : 0;
  if (!placed) return 'Click the same 6 points in two cameras, then in the others';
  const error = found.error == null ? '' : `, ${found.error.toFixed(1)} px`;
  const more = found.spare < 6 ? ' · click more points: few clicks check each other'
    : found.ambiguous ? ' · another arrangement fits as well: click more points' : '';
  return `${placed} of ${cameras.length} cameras${error}${more}`;
}

function render() {
  clock.textContent = `${now.toFixed(3)} s`;
  status.textContent = summary();
  finishing.disabled = finished || !found?.solved;
  undoing.disabled = !past.length;
  redoing.disabled = !future.length;
  panels.forEach((panel, k) => {
    const index = frameOf(k), { name, times } = cameras[k], solved = found?.cameras[k];
    panel.time.textContent = `${times[index].toFixed(3)} s`;
    panel.event.setAttribute('aria-pressed', String(clicks.event[name] === times[index]));
    panel.state.textContent = shown(solved ? solved.missing ?? `posed, focal length ${Math.round(solved.focal)} px` : '');
    panel.state.title = panel.state.textContent;
    panel.node.classList.toggle('bad', !!solved?.missing && !!found.error);
    image(k, index).then(node => { if (node && frameOf(k) === index) panel.view.show(node); });
    panel.view.draw();
  });
  list.replaceChildren(...[...names(), ...[...waiting.keys()].filter(n => !names().includes(n))].map(row));
  lengths.replaceChildren(lengthRow());
}

addEventListener('keydown', e => {
  if (e.target.matches('input:not([type=radio],[type=range],[type=checkbox]), select')) return;
  const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
  if ((e.ctrlKey || e.metaKey) && e.key.toLowerCase() === 'z') {
    e.preventDefault();
    if (e.shiftKey) undo(future, past); else undo(past, future);
  } else if ((e.ctrlKey || e.metaKey) && e.key.toLowerCase() === 'y') {
    e.preventDefault();
    undo(future, past);
  } else if (e.ctrlKey || e.metaKey || e.altKey) {
    return;
  } else if (e.key === 'n') begin(false);
  else if (e.key === 'm') begin(true);
  else if (e.key === ',') step(-1);
  else if (e.key === '.') step(1);
  else if (arrow && e.target.matches('canvas')) {
    const k = panels.findIndex(p => p.view.canvas === e.target), point = active && entry(active);
    const click = point?.clicks.find(x => x.camera === cameras[k].name), by = e.shiftKey ? 2 : 0.25;
    e.preventDefault();
    if (click) put(k, [click.x + by * arrow[0], click.y + by * arrow[1]]);
  } else if (e.key === 'Delete' && e.target.matches('canvas')) {
    const k = panels.findIndex(p => p.view.canvas === e.target), point = active && entry(active);
    if (point) change(() => { point.clicks = point.clicks.filter(x => x.camera !== cameras[k].name); });
  }
});

document.body.append(
  h('header', {}, button('◀', () => step(-1), { 'aria-label': 'Previous frame of all cameras' }), slider,
    button('▶', () => step(1), { 'aria-label': 'Next frame of all cameras' }), clock, undoing, redoing, status, finishing),
  h('main', { style: `--columns:${Math.ceil(Math.sqrt(cameras.length))}` }, ...panels.map(p => p.node)),
  h('aside', {}, alert,
    h('h2', {}, 'Points'),
    h('p', {}, 'Click the same corner in every camera that shows it: six to eight corners, at different depths. Zoom with the '
      + 'wheel or two fingers; arrow keys move a mark. Check the box of points on the floor (three or more).'),
    list, h('div', {}, newStill, ' ', newMoving),
    h('h2', {}, 'Known length'), lengths,
    h('h2', {}, 'Time'),
    h('p', {}, 'Step each camera to the frame of one event, a clap or a foot that lands, and press Event in it. A moving point '
      + 'that is clicked at several times refines the time offsets.')),
);
now = ticks()[0];
document.body.dataset.idle = 'true';
render();
if (clicks.points.length) solve();

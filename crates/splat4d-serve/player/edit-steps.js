// Lists of edits in the page: text, keys over time, undo and redo. Plain data, as edits.toml has it.

import { DEGREE, lerp, quatAbout, quatNormal, slerp } from './camera.js';

/** Keys nearer than this are one, s: less than half a frame of any capture. */
const SAME = 1e-3;

/** Five digits that count. */
export const round = x => +(+x).toPrecision(5);
const rounded = list => list.map(round);

/** Axis and degrees of a rotation; undefined: none. */
export function turnOf(quat) {
  let [w, ...v] = quatNormal(quat);
  if (w < 0) [w, v] = [-w, v.map(x => -x)];
  const s = Math.hypot(...v);
  return s < 1e-6 ? undefined : [...v.map(x => round(x / s)), round(2 * Math.atan2(s, w) / DEGREE)];
}

export const quatOf = turn => (turn ? quatAbout(turn, turn[3] * DEGREE) : [1, 0, 0, 0]);

/** Interpolation parameter: linear, or eased at the ends (as in the library). */
function eased(u, a, b) {
  const [from, to] = [a ? 0 : 1, b ? 0 : 1];
  return u * (from + u * (3 - 2 * from - to + u * (from + to - 2)));
}

/** The keys on both sides of t, and how far it is from the one to the other. */
function around(keys, t) {
  const after = keys.findIndex(k => k.t > t);
  if (after === 0) return [keys[0], keys[0], 0];
  if (after < 0) return [keys.at(-1), keys.at(-1), 0];
  const [a, b] = [keys[after - 1], keys[after]];
  return [a, b, eased((t - a.t) / (b.t - a.t), a.ease, b.ease)];
}

const mix = (a, b, u) => a.map((x, i) => lerp(x, b[i], u));
const placed = p => ({ shift: p.shift ?? [0, 0, 0], quat: quatOf(p.turn), scale: p.scale ?? 1 });

/** The transform of a move at t: {shift, quat, scale, about}. */
export function placeAt(step, t) {
  const about = (step.keys?.length ? step.about : step.to?.about) ?? [0, 0, 0];
  if (!step.keys?.length) return { ...placed(step.to ?? {}), about };
  const [a, b, u] = around(step.keys, t), [p, q] = [placed(a), placed(b)];
  return { shift: mix(p.shift, q.shift, u), quat: slerp(p.quat, q.quat, u),
    scale: Math.exp(lerp(Math.log(p.scale), Math.log(q.scale), u)), about };
}

/** A place in the words of the file. */
function words({ shift, quat, scale }) {
  const turn = turnOf(quat);
  return { shift: rounded(shift), ...(turn && { turn }), ...(Math.abs(scale - 1) > 1e-6 && { scale: round(scale) }) };
}

const near = t => k => Math.abs(k.t - t) < SAME;

/** Keys with one at t that states `value`; how it eases stays. */
function put(keys, t, value) {
  const old = keys.find(near(t));
  const key = { t: round(old?.t ?? t), ...value, ...(old?.ease && { ease: true }) };
  return [...keys.filter(k => k !== old), key].sort((a, b) => a.t - b.t);
}

/** A move with a given transform at t: by a key if it has keys, otherwise at all times. */
export function movedTo(step, t, place) {
  if (step.keys?.length) return { ...step, keys: put(step.keys, t, words(place)) };
  return { ...step, to: { ...words(place), about: rounded(place.about) } };
}

/** A factor of opacity at t. */
export const factorAt = (step, t) => {
  if (!step.keys?.length) return step.factor ?? 1;
  const [a, b, u] = around(step.keys, t);
  return lerp(a.factor, b.factor, u);
};
export const fadedTo = (step, t, factor) => (step.keys?.length
  ? { ...step, keys: put(step.keys, t, { factor: round(factor) }) } : { ...step, factor: round(factor) });

/** Where a handle of a drag is at t, from where it would be. */
export function pulledAt(handle, t) {
  const [a, b, u] = around(handle.keys, t);
  return mix(a.by, b.by, u);
}
/** A handle that is pulled so at t: by a key if it has several, otherwise at all times. */
export function pulledTo(handle, t, by) {
  const value = { by: rounded(by) };
  return { ...handle, keys: handle.keys.length > 1 ? put(handle.keys, t, value) : [{ ...handle.keys[0], ...value }] };
}

/** Steps that can change with time. */
export const keyed = step => ['move', 'opacity', 'drag'].includes(step.do);

/** Keys of a step: [{t, ease}]. */
export function keysOf(step) {
  const all = step.do === 'drag' ? step.handles.flatMap(h => h.keys) : step.keys ?? [];
  const out = [];
  for (const k of [...all].sort((a, b) => a.t - b.t)) if (!out.some(near(k.t))) out.push({ t: k.t, ease: !!k.ease });
  return out;
}

/** The step with a key at t that changes nothing yet. */
export function withKey(step, t) {
  if (step.do === 'drag') {
    const handles = step.handles.map(h => ({ ...h, keys: put(h.keys, t, { by: rounded(pulledAt(h, t)) }) }));
    return { ...step, handles };
  }
  if (step.do === 'opacity') {
    const { factor, ...rest } = step;
    return { ...rest, keys: put(step.keys ?? [], t, { factor: round(factorAt(step, t)) }) };
  }
  const place = placeAt(step, t), { to, ...rest } = step;
  return { ...rest, about: rounded(place.about), keys: put(step.keys ?? [], t, words(place)) };
}

/** The step with its keys changed by `f`, from list to list. Without keys a move or fade applies at all times. */
function rekeyed(step, f) {
  if (step.do === 'drag') {
    return { ...step, handles: step.handles.map(h => ({ ...h, keys: f(h.keys) })).filter(h => h.keys.length) };
  }
  const keys = f(step.keys ?? []).sort((a, b) => a.t - b.t);
  if (keys.length) return { ...step, keys };
  const { keys: old, about, ...rest } = step;
  if (step.do === 'opacity') return { ...rest, factor: old[0]?.factor ?? 1 };
  const { t, ease, ...place } = old[0] ?? {};
  return { ...rest, to: { ...place, about } };
}

export const withoutKey = (step, t) => rekeyed(step, keys => keys.filter(k => !near(t)(k)));
export const easedKey = (step, t, ease) => rekeyed(step, keys => keys.map(k => {
  if (!near(t)(k)) return k;
  const { ease: old, ...rest } = k;
  return ease ? { ...rest, ease } : rest;
}));
/** Moves a key in time, replacing one that is there. */
export const shiftedKey = (step, from, to) => rekeyed(step, keys => {
  const moved = keys.find(near(from));
  if (!moved) return keys;
  return [...keys.filter(k => k !== moved && !near(to)(k)), { ...moved, t: round(to) }].sort((a, b) => a.t - b.t);
});

/** Two selections as one: 'new', 'add', 'remove', 'within'. */
export function combined(old, text, how) {
  if (!old.trim() || how === 'new') return text;
  const all = s => (/ (and|or) |^not /.test(s) ? `(${s})` : s);
  return { add: `${old} or ${text}`, remove: `${all(old)} and not ${all(text)}`, within: `${all(old)} and ${all(text)}` }[how];
}

/** What can be replayed: a bend that nothing pulls yet is left out. */
export const ready = steps => steps.filter(s => s.do !== 'drag' || s.handles.length);

/** What was done, undone and can be done again. */
const BOX = /\bbox\(([^()]*)\)(?![^]*\bbox\()/;
/** The last box of a selection in words, {low, high}; null where there is none, or it is not six numbers. */
export function boxOf(text) {
  const n = (BOX.exec(text)?.[1] ?? '').split(/[\s,]+/).filter(Boolean).map(Number);
  if (n.length !== 6 || !n.every(isFinite)) return null;
  const [a, b] = [n.slice(0, 3), n.slice(3)];
  return { low: a.map((x, k) => Math.min(x, b[k])), high: a.map((x, k) => Math.max(x, b[k])) };
}
/** The words with another box in its place. */
export const withBox = (text, { low, high }) => text.replace(BOX, `box(${low.map(round)}, ${high.map(round)})`);

export class History {
  #past = [];
  #future = [];
  steps;
  saved;

  constructor(steps) { this.steps = this.saved = steps; }

  /** `over`: in place of what was done last, so that one long pull is one step to undo. */
  push(steps, over = false) {
    if (!over) this.#past.push(this.steps);
    this.#future = [];
    this.steps = steps;
  }
  undo() { this.#go(this.#past, this.#future); }
  redo() { this.#go(this.#future, this.#past); }
  #go(from, to) {
    if (!from.length) return;
    to.push(this.steps);
    this.steps = from.pop();
  }
  get undoable() { return this.#past.length > 0; }
  get redoable() { return this.#future.length > 0; }
  get dirty() { return JSON.stringify(ready(this.steps)) !== JSON.stringify(ready(this.saved)); }
}

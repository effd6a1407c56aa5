// Editing: a panel over the player, and its requests to the program that serves the page. The list of edits is the
// page's; the program replays it, and only it can change a scene: nothing here touches a Gaussian.

import { History, boxOf, combined, easedKey, factorAt, fadedTo, keyed, keysOf, movedTo, placeAt, pulledAt, pulledTo, quatOf,
  ready, round, shiftedKey, turnOf, withBox, withKey, withoutKey } from './edit-steps.js';
import { Overlay } from './edit-tools.js';
import { allow, button, choice, clock, field, h, segments, tool } from './dom.js';
import { clamp } from './camera.js';

/** Longer side of images that the program draws, pixels: at rest, and while something is pulled. */
const SIDE = 960, SIDE_PULLING = 384;
/** Rest after which the selection is looked up at another time, ms. */
const REST = 180;
/** Nodes of a bend. */
const NODES = 512;
/** Radius of a handle, of the selection's spread: some nodes around the one that is taken. */
const GRIP = 0.12;

/** Steps, as they are shown; what the page offers of each is in this file. */
const NAMES = { delete: 'Delete', crop: 'Keep only', hide: 'Hide', recolor: 'Colour', opacity: 'Opacity', move: 'Move',
  duplicate: 'Duplicate', split: 'Split off', cut: 'Cut', retime: 'Retime', merge: 'Merge', drag: 'Bend',
  floaters: 'Floaters' };
const nameOf = step => NAMES[step.do] ?? step.do;

const TOOLS = [['', 'Look'], ['box', 'Box'], ['sphere', 'Sphere'], ['lasso', 'Lasso'], ['color', 'Colour']];
const HOW = [['new', 'New'], ['add', 'Add'], ['remove', 'Remove'], ['within', 'Within']];
const PLAIN = [['size(0.1, 99)', 'Size', 'Select by size: size(min, max), in scene units'],
  ['speed(0.1, 99)', 'Speed', 'Select by speed: speed(min, max), in scene units per second'],
  ['life(0, 0.1)', 'Lifespan', 'Select by lifespan: life(min, max), in seconds']];
const WORDS = [['all', 'Everything'], ['opacity(0, 0.1)', 'Opacity …'], ['color(1,0,0, 0.2)', 'Colour …'], ['sphere(0,0,0, 1)', 'Sphere …'], ['box(-1,-1,-1, 1,1,1)', 'Box …']];

const ACTS = { Delete: 'Delete the selection', 'Keep only': 'Delete everything else', Hide: 'Hide the selection for a time range',
  Colour: 'Change exposure, saturation and tint', Opacity: 'Change the opacity, also over time', Move: 'Shift, rotate and scale, also over time',
  Bend: 'Deform: drag nodes to another pose' };
const TOOL_TITLES = { '': 'Turn and move the camera', box: 'Drag a box over the image', sphere: 'Drag outwards from the centre',
  lasso: 'Draw a line around the object', color: 'Click a colour in the image' };
const HOW_TITLES = { new: 'Replace the selection', add: 'Add to the selection', remove: 'Remove from the selection',
  within: 'Keep only what both selections contain' };

const STYLE = `
.edit-overlay{position:absolute;inset:0;width:100%;height:100%;pointer-events:none}
.edit>*{flex:none}
.edit.setting .acts{display:none}
.edit .row{gap:.35em;flex-wrap:wrap}
.edit textarea{width:100%;font:.85em/1.45 ui-monospace,"DejaVu Sans Mono",monospace;color:inherit;background:var(--raised);
 border:1px solid var(--line);border-radius:.6em;padding:.5em .6em;resize:vertical;min-height:3.6em}
.edit textarea:focus-visible{outline:2px solid var(--accent);outline-offset:1px}
.edit .said{min-height:1.3em;overflow-wrap:anywhere}
.edit .said.bad{color:var(--bad)}
.edit .acts{display:grid;grid-template-columns:repeat(4,1fr);gap:.4em}
.edit .acts .soft{padding:.5em .2em}
.edit ol{list-style:none;margin:0;padding:0;display:flex;flex-direction:column;gap:.3em;max-height:9em;overflow:auto}
.edit li{display:flex;align-items:center;gap:.3em;background:var(--raised);border-radius:.6em}
.edit li[aria-current=true]{box-shadow:0 0 0 1.5px var(--accent)}
.edit li>button:first-child{flex:1;min-width:0;justify-content:flex-start;overflow:hidden}
.edit li small{color:var(--muted);overflow:hidden;text-overflow:ellipsis}
.edit .props{display:flex;flex-direction:column;gap:.5em;border-left:2px solid var(--accent);padding-left:.8em}
.edit .props[hidden]{display:none}
.edit input[type=number]{width:5.4em;background:var(--raised);border:0;padding:.3em .1em .3em .5em;border-radius:.5em}
.edit .boxed{display:grid;grid-template-columns:auto 1fr 1fr;gap:.35em .6em;align-items:center}.edit .boxed[hidden]{display:none}
.edit .boxed span{display:contents}.edit .boxed input{width:100%}
.edit input[type=range]{flex:1;min-width:7em;accent-color:var(--accent)}
.edit input[type=color]{width:3em;height:2em;padding:0;border:0;background:none}
.edit label.check{display:inline-flex;align-items:center;gap:.4em;color:var(--muted);font-size:.9em}
.edit .state{color:var(--muted);font-size:.85em;font-weight:400;margin-left:.6em}
.edit .head .row{gap:.1em;flex-wrap:nowrap}
.edit .head h2{flex:1;white-space:nowrap;overflow:hidden;text-overflow:ellipsis}
.edit .keys span{font-size:.88em;flex:0}
.editkey{position:absolute;top:50%;width:.85em;height:.85em;margin:-.425em;transform:rotate(45deg);border-radius:.15em;
 background:#ffb224;box-shadow:0 0 0 .15em var(--surface);cursor:ew-resize;touch-action:none;padding:0;z-index:1}
.editkey.ease{border-radius:50%}
@container (max-width:760px){.panel.edit{max-height:44cqh;gap:.7em}.edit.setting .choose{display:none}.edit .acts .soft{padding:.65em .2em}}
@container (max-width:420px){.bar:has(.opener) .time .of{display:none}}
`;

const number = (label, value, onchange, props = {}) => {
  const node = h('input', { type: 'number', step: 'any', 'aria-label': label, value, ...props,
    onchange: () => { if (node.value !== '' && isFinite(node.value)) onchange(+node.value); } });
  return node;
};
const slider = (label, low, high, value, onchange, oninput) => {
  const node = h('input', { type: 'range', min: low, max: high, step: high > 2 ? 0.05 : 0.01, 'aria-label': label, value,
    onchange: () => onchange(+node.value), oninput: () => oninput?.(+node.value) });
  return node;
};

/** The program refuses a list. Other errors of a request are of the connection, which also breaks when a page is left. */
class Refusal extends Error {}

/** One editing page. `ui`: the player's face; `token`: the leave that the page's address brought. */
export class Editing {
  #timers = {};
  #run = 0;
  /** Whether a substitute image is shown, one is being made for another view, and one is needed for yet another. */
  #standing = false;
  #looking = false;
  #again = false;
  /** Number of the newest look-up of a selection. */
  #lookup = 0;
  #bent = null;
  #bending = 0;
  #busy = 0;
  #told = null;
  /** Number of the step that is being set, or -1. */
  active = -1;
  text = '';
  how = 'new';
  done = [];

  static async start(ui, token, address = './edit') {
    const editing = new Editing(ui, token, address);
    await editing.#open();
    return editing;
  }

  constructor(ui, token, address) {
    Object.assign(this, { ui, token, address, player: ui.player, history: new History([]) });
  }

  // Requests.

  async ask(body) {
    this.#busy++;
    this.#state();
    try {
      const answer = await fetch(this.address, { method: 'POST', body: JSON.stringify(body),
        headers: { 'content-type': 'application/json', 'x-splat4d-token': this.token } });
      const told = answer.headers.get('content-type')?.includes('json') ? await answer.json() : { error: await answer.text() };
      if (!answer.ok) throw new Refusal(told.error);
      return told;
    } finally {
      this.#busy--;
      this.#state();
    }
  }

  /** Whether nothing is requested, and the scene is that of the list. */
  get idle() { return !this.#busy && !this.#standing && !this.overlay.shows; }
  get time() { return this.player.time; }
  get steps() { return this.history.steps; }
  get step() { return this.steps[this.active]; }
  /** The steps before the one that is being set, or all: what selections are of. */
  get before() { return ready(this.active < 0 ? this.steps : this.steps.slice(0, this.active)); }

  /** The player's view, as a camera of at most this many pixels per side. */
  view(side = SIDE) {
    const { clientWidth: w, clientHeight: height } = this.player.stage, k = Math.min(1, side / Math.max(w, height, 1));
    const [width, tall] = [w, height].map(x => Math.max(1, Math.round(x * k)));
    const { view } = this.player.drawing(width, tall), c = this.player.camera;
    return { position: c.position, quat: c.quat, fx: view.fx, fy: view.fy, cx: view.cx, cy: view.cy, near: view.near, width, height: tall };
  }

  async #open() {
    const kept = this.#kept(s => JSON.parse(s.getItem(this.#keptAs)));
    this.about = await this.ask({ do: 'open', ...(kept && { kept: ready(kept) }) });
    this.history = new History(this.about.steps);
    if (kept) this.history.push(kept);
    this.overlay = new Overlay(this.player);
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(STYLE);
    const shadow = this.ui.root.getRootNode();
    shadow.adoptedStyleSheets = [...shadow.adoptedStyleSheets, sheet];
    this.#build();
    this.#listen();
    this.refresh();
    this.toggle(true);
    // The scene that was loaded is of another list: another page's, or one that was not saved.
    if (this.about.stale) this.#apply();
  }

  /** Edits that are not saved outlive a reload of this tab, and nothing else. */
  get #keptAs() { return `splat4d-edits-${this.token}`; }
  #kept(f) { try { return f(sessionStorage); } catch { return null; /* Storage may be shut. */ } }
  #keep() {
    const { dirty } = this.history;
    this.#kept(s => (dirty ? s.setItem(this.#keptAs, JSON.stringify(this.steps)) : s.removeItem(this.#keptAs)));
  }

  #build() {
    const { ui } = this;
    this.opener = tool('edit', 'Edit (X)', () => this.toggle(), { class: 'tool opener', 'aria-expanded': 'false' });
    ui.openers.view.after(this.opener);
    this.undoTool = tool('undo', 'Undo (Ctrl+Z)', () => this.undo());
    this.redoTool = tool('redo', 'Redo (Ctrl+Y)', () => this.redo());
    this.saveTool = tool('save', 'Save (Ctrl+S)', () => this.save());
    this.stateText = h('span', { class: 'state', role: 'status' });
    this.tools = segments('Select with', TOOLS.map(([v, text]) => [v, text, TOOL_TITLES[v]]), t => this.setTool(t || null));
    this.hows = segments('Combine', HOW.map(([v, text]) => [v, text, HOW_TITLES[v]]), v => { this.how = v; });
    this.through = h('input', { type: 'checkbox' });
    this.now = h('input', { type: 'checkbox' });
    const layers = this.about.layers.map(name => [`layer("${name}")`, `Layer ${name}`]);
    this.more = choice('More selections', [['', 'More …'], ...layers, ...WORDS], v => {
      if (v) this.#pick(v);
      this.more.value = '';
    });
    this.area = h('textarea', { 'aria-label': 'Selection as text', rows: 3, spellcheck: 'false',
      placeholder: 'Draw over the image, or type: box(…) and not layer(sky)',
      onchange: () => { this.text = this.area.value; this.#changedSelection(); } });
    this.boxed = h('div', { class: 'boxed', role: 'group', 'aria-label': 'Box', hidden: true }, ...'xyz'.split('').map((axis, k) => h('span', {},
      `${axis} `, ...['low', 'high'].map((end, i) => number(`Box ${axis} ${['from', 'to'][i]}`, 0, v => {
        const box = boxOf(this.text);
        if (box) this.#setBox({ ...box, [end]: box[end].map((x, j) => (j === k ? v : x)) });
      })))));
    this.said = h('p', { class: 'note said', role: 'status', 'aria-live': 'polite' });
    const act = (label, make, props) => button(label, () => make(), props);
    this.acts = h('div', { class: 'acts', role: 'group', 'aria-label': 'Actions on the selection' },
      act('Delete', () => this.add({ do: 'delete' })), act('Keep only', () => this.add({ do: 'crop' })),
      act('Hide', () => this.add({ do: 'hide', from: round(this.time), to: round(this.player.last + this.player.frameTime) })),
      act('Colour', () => this.add({ do: 'recolor', exposure: 0.5 })),
      act('Opacity', () => this.add({ do: 'opacity', factor: 0.5 })),
      act('Move', () => this.add({ do: 'move', to: { shift: [0, 0, 0], about: (this.#told?.center ?? [0, 0, 0]).map(round) } }, true)),
      act('Bend', () => this.add({ do: 'drag', at: round(this.time), nodes: NODES, handles: [], pins: [] }, true),
        this.about.drag ? {} : { disabled: true, title: 'Not available for playback files. Open the run folder instead.' }),
      act('Floaters', () => this.propose(), this.about.floaters ? {} : { disabled: true, title: 'Not available: floaters are found in the training images. Open the run folder instead.' }));
    this.list = h('ol', { 'aria-label': 'Edits' });
    this.props = h('div', { class: 'props', role: 'group' });
    const check = (box, text, title) => h('label', { class: 'check', title }, box, text);
    this.panel = h('section', { class: 'card panel edit', role: 'dialog', 'aria-label': 'Edit', hidden: true },
      h('div', { class: 'head' }, h('h2', {}, 'Edit', this.stateText), h('div', { class: 'row' }, this.undoTool, this.redoTool,
        this.saveTool, tool('close', 'Close', () => this.toggle(false)))),
      h('div', { class: 'row choose' }, this.tools), h('div', { class: 'row choose' },
        ...PLAIN.map(([words, text, title]) => button(text, () => this.#pick(words), { title })), this.more), h('div', { class: 'row choose' }, this.hows,
        check(this.through, 'Through', 'Also select Gaussians behind the visible surface'),
        this.about.moving ? check(this.now, 'Now', 'Select by positions at this time. Otherwise: by positions at most times of the lifespan') : null),
      this.area, this.said, this.acts, this.boxed, this.list, this.props);
    ui.dock.insertBefore(this.panel, ui.bar);
    ui.help.querySelector('dl')?.append(...[['Edit', 'X'], ['Undo, redo', 'Ctrl + Z', 'Y'], ['Save the edits', 'Ctrl + S'], ['Delete the selection', 'Del']]
      .map(([what, ...keys]) => h('div', { class: 'pair' }, h('dt', {}, what), h('dd', {}, ...keys.map(k => h('kbd', {}, k))))));
    ui.editing = this;
    this.tools.set('');
    this.hows.set('new');
  }

  #listen() {
    const p = this.player, o = this.overlay;
    o.addEventListener('drawn', e => this.#drawn(e.detail));
    o.addEventListener('boxing', e => this.#numbers(e.detail.box));
    o.addEventListener('boxed', e => this.#setBox(e.detail.box));
    o.addEventListener('moving', () => this.#moving());
    o.addEventListener('moved', e => this.#set(movedTo(this.step, this.time, e.detail.place)));
    o.addEventListener('pulling', () => this.#pulling());
    o.addEventListener('pulled', e => this.#pulled(e.detail.node));
    o.addEventListener('pin', e => this.#pin(e.detail.node));
    this.ends = [];
    const on = (target, name, f) => { target.addEventListener(name, f); this.ends.push(() => target.removeEventListener(name, f)); };
    on(p, 'timeupdate', () => this.#timeChanged());
    on(p, 'camerachange', () => this.#follow());
    on(window, 'keydown', e => this.#key(e));
    on(window, 'beforeunload', e => { if (this.history.dirty) e.preventDefault(); });
  }

  #key(e) {
    if (!this.open || e.defaultPrevented) return;
    const at = e.composedPath()[0], typing = at instanceof Element && at.matches('textarea, input:not([type=radio], [type=checkbox], [type=range])');
    const key = e.key.toLowerCase(), ctrl = e.ctrlKey || e.metaKey;
    const act = ctrl && key === 's' ? () => this.save()
      : typing ? null
        : ctrl && key === 'z' ? () => (e.shiftKey ? this.redo() : this.undo())
          : ctrl && key === 'y' ? () => this.redo()
            : !ctrl && (e.key === 'Delete' || e.key === 'Backspace') && this.text && this.active < 0 ? () => this.add({ do: 'delete' }) : null;
    if (act) { e.preventDefault(); act(); }
  }

  // The panel.

  get open() { return !this.panel.hidden; }

  toggle(on = !this.open) {
    if (on) this.ui.open(null, false);
    this.panel.hidden = !on;
    this.opener.setAttribute('aria-expanded', String(on));
    this.overlay.canvas.hidden = !on;
    this.overlay.box = on && this.active < 0 ? boxOf(this.text) : null;
    if (!on) this.setTool(null);
    this.#diamonds();
    this.ui.wake();
  }

  /** Escape: the tool, then the step, then the panel. True: there was something to end. */
  escape() {
    if (!this.open) return false;
    if (this.overlay.tool && !['move', 'bend'].includes(this.overlay.tool)) this.setTool(null);
    else if (this.active >= 0) this.activate(-1);
    else this.toggle(false);
    return true;
  }

  setTool(name) {
    if (name && this.active >= 0) this.activate(-1);
    this.overlay.setTool(name);
    this.tools.set(['move', 'bend'].includes(name) || !name ? '' : name);
  }

  say(text, bad = false) {
    this.said.textContent = text;
    this.said.classList.toggle('bad', bad);
  }

  #state() {
    if (!this.stateText) return;
    this.stateText.textContent = this.#busy ? 'Working …' : this.history.dirty ? 'Not saved' : this.about.file;
    this.panel.setAttribute('aria-busy', String(this.#busy > 0));
  }

  refresh() {
    const { history } = this, focused = this.panel.contains(this.ui.focused()) ? this.ui.focused().getAttribute('aria-label') : null;
    allow(this.undoTool, !history.undoable && 'Nothing to undo', 'Undo (Ctrl+Z)');
    allow(this.redoTool, !history.redoable && 'Nothing to redo', 'Redo (Ctrl+Y)');
    allow(this.saveTool, !history.dirty && 'All edits are saved', 'Save (Ctrl+S)');
    this.#keep();
    this.#numbers(this.overlay.box = this.active < 0 && this.open ? boxOf(this.text) : null);
    this.overlay.redraw();
    this.list.hidden = !this.steps.length;
    this.list.replaceChildren(...this.steps.map((s, i) => h('li', { 'aria-current': String(i === this.active) },
      button('', () => this.activate(i === this.active ? -1 : i), { 'aria-label': `Change edit ${i + 1}: ${nameOf(s)}`, class: '' }),
      tool('bin', `Remove edit ${i + 1}`, () => this.remove(i)))));
    [...this.list.children].forEach((li, i) => li.firstChild.append(h('b', {}, nameOf(this.steps[i])),
      h('small', {}, this.done[i] ? `${this.done[i].selected.toLocaleString('en-GB')} · ` : '', this.steps[i].select ?? '')));
    if (this.area !== this.ui.focused()) this.area.value = this.text;
    const some = this.#told?.gaussians > 0 && this.active < 0;
    for (const b of this.acts.children) {
      if (b.textContent === 'Floaters' || (b.textContent === 'Bend' && !this.about.drag)) continue;
      allow(b, !some && (this.active < 0 ? 'Select something first' : 'Close the open edit first: click it in the list'), ACTS[b.textContent]);
    }
    this.#properties();
    this.#diamonds();
    this.#state();
    // A keyframe made again keeps its owner.
    if (focused && !this.panel.contains(this.ui.focused())) this.panel.querySelector(`[aria-label="${CSS.escape(focused)}"]`)?.focus();
  }

  #properties() {
    const focused = this.props.contains(this.ui.focused()) ? this.ui.focused() : null, keep = focused?.getAttribute('aria-label');
    // A changed field sends its value when it loses the focus, which builds the fields again: not while they are being replaced.
    focused?.blur();
    const step = this.step;
    this.props.hidden = !step;
    this.panel.classList.toggle('setting', !!step);
    this.props.replaceChildren(...(step ? this.#fields(step) : []));
    this.props.setAttribute('aria-label', step ? `${nameOf(step)}, edit ${this.active + 1}` : '');
    if (keep) this.props.querySelector(`[aria-label="${CSS.escape(keep)}"]`)?.focus();
  }

  #fields(step) {
    const set = (more, over) => this.#set({ ...step, ...more }, over);
    const out = [];
    if (step.do === 'hide') {
      out.push(field('From, s', number('From', step.from, v => set({ from: v }))), field('To, s', number('To', step.to, v => set({ to: v }))));
    } else if (step.do === 'recolor') {
      const hex = '#' + (step.tint ?? [1, 1, 1]).map(c => Math.round(255 * clamp(c, 0, 1)).toString(16).padStart(2, '0')).join('');
      const tint = h('input', { type: 'color', 'aria-label': 'Tint', value: hex,
        onchange: () => set({ tint: [1, 3, 5].map(i => round(parseInt(tint.value.slice(i, i + 2), 16) / 255)) }) });
      out.push(field('Exposure', slider('Exposure, stops', -3, 3, step.exposure ?? 0, v => set({ exposure: round(v) }))),
        field('Saturation', slider('Saturation', 0, 2, step.saturation ?? 1, v => set({ saturation: round(v) }))), field('Tint', tint));
    } else if (step.do === 'opacity') {
      out.push(field('Opacity', slider('Opacity', 0, 1, factorAt(step, this.time), v => this.#set(fadedTo(step, this.time, v)))));
    } else if (step.do === 'move') {
      const place = placeAt(step, this.time), turn = turnOf(place.quat) ?? [...this.player.camera.up.map(round), 0];
      const put = more => this.#set(movedTo(step, this.time, { ...place, ...more }));
      out.push(field('Shift', h('div', { class: 'row' }, ...'xyz'.split('').map((axis, k) => number(`Shift ${axis}`, round(place.shift[k]),
        v => put({ shift: place.shift.map((x, i) => (i === k ? v : x)) }))))),
      field('Turn, °', number('Turn', turn[3], v => put({ quat: quatOf([...turn.slice(0, 3), v]) }))),
      field('Scale', number('Scale', round(place.scale), v => v > 0 && put({ scale: v }))));
    } else if (step.do === 'drag') {
      out.push(h('p', { class: 'note' }, step.handles.length
        ? 'Drag nodes. Click a node to pin it.' : 'Drag a node: its surroundings follow. Click a node to pin it.'),
      field('Nodes', h('span', {}, `${step.handles.length} dragged, ${(step.pins ?? []).length} pinned`)));
      if (this.#bent?.own && !step.handles.length && !step.pins?.length) {
        const own = h('input', { type: 'checkbox', 'aria-label': 'Nodes of the model', ...(!step.nodes && { checked: true }),
          onchange: () => { this.#set({ ...step, nodes: own.checked ? 0 : NODES }); this.#bend(); } });
        out.push(field('Nodes of the model', own));
      }
    } else if (step.do === 'floaters') {
      out.push(field('Strength', slider('Strength', 0, 1, step.strength, v => set({ strength: round(v) }))));
    }
    if (keyed(step) && this.about.moving) out.push(this.#keyList(step));
    return out;
  }

  #keyList(step) {
    const keys = keysOf(step), list = step.do === 'drag' && keys.length < 2 ? [] : keys;
    return h('div', {}, h('ul', { class: 'keys', 'aria-label': 'Keys' }, ...list.map((k, i) => h('li', {},
      button(clock(k.t - this.player.first, this.player.duration), () => this.player.seek(k.t), { 'aria-label': `Go to key ${i + 1}`, class: '' }),
      h('label', { class: 'check' }, h('input', { type: 'checkbox', 'aria-label': `Ease key ${i + 1}`, ...(k.ease && { checked: true }),
        onchange: e => this.#set(easedKey(step, k.t, e.target.checked)) }), 'ease'),
      tool('bin', `Delete key ${i + 1}`, () => this.#set(withoutKey(step, k.t)))))),
    h('div', { class: 'wrap' }, button('Add key here', () => this.#set(withKey(step, this.time)),
      step.do === 'drag' && !step.handles.length ? { disabled: true, title: 'Drag a node first' }
        : { title: 'Add a key frame here. Changes at other times then add their own key frames' })));
  }

  /** Keys of the step that is set, on the time line. */
  #diamonds() {
    for (const old of [...this.ui.scrub.querySelectorAll('.editkey')]) old.remove();
    const step = this.open ? this.step : null, p = this.player;
    if (!step || !keyed(step) || !p.duration) return;
    const keys = keysOf(step);
    if (step.do === 'drag' && keys.length < 2) return;
    for (const k of keys) {
      let at = k.t;
      const place = () => { node.style.left = `${100 * clamp((at - p.first) / p.duration, 0, 1)}%`; };
      const node = h('button', { type: 'button', class: `editkey${k.ease ? ' ease' : ''}`, 'aria-label': `Key at ${round(k.t - p.first)} seconds`,
        onpointerdown: e => { e.stopPropagation(); node.setPointerCapture(e.pointerId); },
        onpointermove: e => {
          if (!node.hasPointerCapture(e.pointerId)) return;
          e.stopPropagation();
          const box = this.ui.rail.getBoundingClientRect();
          at = p.first + clamp((e.clientX - box.left) / Math.max(box.width, 1), 0, 1) * p.duration;
          place();
        },
        onpointerup: e => {
          e.stopPropagation();
          if (Math.abs(at - k.t) > p.frameTime / 2) this.#set(shiftedKey(this.step, k.t, at));
          else p.seek(k.t);
        },
        onkeydown: e => {
          const way = { ArrowLeft: -1, ArrowRight: 1 }[e.key];
          if (way) { e.preventDefault(); e.stopPropagation(); this.#set(shiftedKey(this.step, k.t, clamp(k.t + way * p.frameTime, p.first, p.last))); }
          else if (e.key === 'Enter') { e.stopPropagation(); p.seek(k.t); }
        } });
      place();
      this.ui.scrub.append(node);
    }
  }

  // Selections.

  #pick(words) {
    if (this.active >= 0) this.activate(-1);
    this.text = combined(this.text, words, this.how);
    this.#changedSelection();
  }

  /** The box that a selection in words ends with: its numbers in the panel. */
  #numbers(box) {
    this.boxed.hidden = !box;
    if (!box) return;
    [...this.boxed.querySelectorAll('input')].forEach((input, i) => {
      if (input !== this.ui.focused()) input.value = round((i % 2 ? box.high : box.low)[i >> 1]);
    });
  }

  #setBox(box) {
    this.text = withBox(this.text, box);
    this.#changedSelection();
  }

  #changedSelection() {
    if (this.step?.select !== undefined && this.text.trim()) return this.#set({ ...this.step, select: this.text });
    this.refresh();
    this.#select();
  }

  async #drawn({ shape, corners }) {
    try {
      const told = await this.ask({ do: 'pick', steps: this.before, shape, corners, view: this.view(), t: this.time,
        through: this.through.checked, now: this.now.checked });
      this.text = combined(this.text, told.select, this.how);
      if (this.text === told.select) this.#tell(told);
      else await this.#select();
    } catch (error) { this.say(error.message, true); }
    this.refresh();
  }

  /** Requests the selected Gaussians, at this time. */
  async #select() {
    const run = ++this.#lookup, text = this.text.trim();
    if (!text) return this.#tell(null);
    try {
      const told = await this.ask({ do: 'select', steps: this.before, select: text, t: this.time });
      if (run === this.#lookup) this.#tell(told);
    } catch (error) {
      if (run !== this.#lookup) return;
      this.#tell(null);
      this.say(error.message, true);
    }
    this.refresh();
  }
  #tell(told) {
    this.#told = told;
    this.overlay.points = told?.points ?? [];
    this.#place();
    if (!told) return this.say('');
    const n = x => x.toLocaleString('en-GB');
    const counts = told.seen.map(([, count]) => count);
    const over = counts.length > 1 ? ` Active over the clip: ${counts.map(n).join(', ')}.` : '';
    const psnr = told.psnr ? ` ${told.pictures} held-out images: ${told.psnr[0].toFixed(2)} dB with, ${told.psnr[1].toFixed(2)} dB without.` : '';
    this.say(`${n(told.gaussians)} of ${n(told.of)} Gaussians selected, ${n(told.now)} visible now.${psnr || over}`);
  }

  /** The similarity by which dots and handles are drawn. */
  #place() {
    this.overlay.place = this.step?.do === 'move' ? placeAt(this.step, this.time) : null;
    this.overlay.redraw();
  }

  #timeChanged() {
    this.#place();
    if (!this.open) return;
    clearTimeout(this.#timers.time);
    this.#timers.time = setTimeout(() => {
      if (this.player.playing) return this.#timeChanged();
      if (this.step && keyed(this.step)) this.#properties();
      if (this.step?.do === 'drag') this.#bend();
      else if (this.text && !this.#told?.psnr) this.#select();
      this.#follow();
    }, REST);
  }

  // Steps.

  /** A step with the selection behind all others. `quiet`: it changes nothing yet. */
  add(step, quiet = false) {
    if (!this.text.trim() || !(this.#told?.gaussians > 0)) return this.say('Select something first', true);
    const { do: kind, ...rest } = step;
    this.setTool(null);
    this.history.push([...this.steps, { do: kind, select: this.text.trim(), ...rest }]);
    const stays = ['move', 'drag', 'recolor', 'opacity', 'hide'].includes(kind);
    if (!stays) { this.text = ''; this.#tell(null); }
    if (!quiet) this.#apply();
    this.activate(stays ? this.steps.length - 1 : -1);
  }

  remove(i) {
    this.history.push(this.steps.filter((_, k) => k !== i));
    this.activate(-1);
    this.#apply();
  }

  /** The step that is set becomes another. */
  #set(step, over = false) {
    if (this.active < 0) return;
    this.history.push(this.steps.map((s, i) => (i === this.active ? step : s)), over);
    this.#place();
    this.refresh();
    this.#apply();
  }

  activate(i) {
    this.active = i;
    const step = this.step;
    if (step) {
      this.text = step.select ?? '';
      this.overlay.setTool({ move: 'move', drag: 'bend' }[step.do] ?? null);
      this.tools.set('');
    } else if (['move', 'bend'].includes(this.overlay.tool)) {
      this.overlay.setTool(null);
    }
    this.overlay.nodes = [];
    this.overlay.points = step?.select === undefined && step ? [] : this.overlay.points;
    this.refresh();
    this.#place();
    if (step?.do === 'drag') this.#bend();
    else if (this.text) this.#select();
    else this.#tell(null);
  }

  undo() { this.history.undo(); this.#jumped(); }
  redo() { this.history.redo(); this.#jumped(); }
  #jumped() {
    if (this.active >= this.steps.length) this.active = -1;
    this.activate(this.active);
    this.#apply();
  }

  async propose() {
    const strength = this.strength ?? 0.5;
    this.setTool(null);
    this.say('Checking every camera …');
    try {
      const told = await this.ask({ do: 'floaters', steps: ready(this.steps), strength, t: this.time });
      this.activate(-1);
      this.text = '';
      this.#tell(told);
      this.refresh();
      const range = slider('Strength', 0, 1, strength, v => { this.strength = v; this.propose(); });
      this.props.hidden = false;
      this.props.replaceChildren(field('Strength', range), h('div', { class: 'wrap' },
        button(`Delete ${told.gaussians.toLocaleString('en-GB')}`, () => {
          this.history.push([...this.steps, { do: 'floaters', strength: round(strength) }]);
          this.#tell(null);
          this.refresh();
          this.#apply();
        }, told.gaussians ? { class: 'soft main' } : { disabled: true, title: 'No floaters at this strength' }),
        button('Keep them', () => { this.#tell(null); this.refresh(); })));
    } catch (error) { this.say(error.message, true); }
  }

  /** The list is replayed: at once as an image, then as a scene that plays. */
  async #apply() {
    const run = ++this.#run, steps = ready(this.steps);
    this.#standing = true;
    this.refresh();
    try {
      await this.#look(steps, run);
      if (run !== this.#run) return;
      const { version, stale } = await this.ask({ do: 'bake', steps });
      if (run !== this.#run || stale) return;
      await this.player.load(new URL(`scene.s4d?v=${version}`, document.baseURI).href, { keep: true });
    } catch (error) {
      if (run !== this.#run) return;
      if (error instanceof Refusal) this.#refused(error);
      else this.say(`No answer from the program: ${error.message}. The edits stay in this tab; change or undo one to try again.`, true);
    }
    if (run !== this.#run) return;
    this.#standing = false;
    if (!this.overlay.busy) this.overlay.show(null);
  }

  /** A step that cannot be done does not stay; redo brings it back. */
  #refused(error) {
    this.history.undo();
    this.active = -1;
    this.overlay.setTool(null);
    this.refresh();
    this.say(error.message, true);
  }

  /** The program's own image of the list from here, shown until the scene is baked. */
  async #look(steps, run) {
    const told = await this.ask({ do: 'show', steps, view: this.view(), t: this.time });
    if (run !== this.#run || !this.#standing) return;
    this.done = told.done;
    await this.overlay.show(told.picture);
    this.refresh();
  }

  /** The preview image follows camera and time. */
  async #follow() {
    if (!this.#standing || this.overlay.busy) return;
    this.#again = true;
    if (this.#looking) return;
    this.#looking = true;
    try {
      while (this.#again && this.#standing) {
        this.#again = false;
        await this.#look(ready(this.steps), this.#run);
      }
    } catch { /* The caller that requested the list gets the error. */ } finally { this.#looking = false; }
  }

  async save() {
    try {
      const steps = ready(this.steps);
      await this.ask({ do: 'save', steps });
      this.history.saved = steps;
      this.ui.toast(`Saved to ${this.about.file}`);
    } catch (error) { this.say(error.message, true); }
    this.refresh();
  }

  #moving() {
    // Numbers next to the handles follow; the image comes when they are let go.
    const shift = this.overlay.place?.shift;
    'xyz'.split('').forEach((axis, k) => {
      const input = this.props.querySelector(`[aria-label="Shift ${axis}"]`);
      if (input && shift) input.value = round(shift[k]);
    });
  }

  // Bending.

  async #bend() {
    const step = this.step, run = ++this.#bending;
    try {
      const told = await this.ask({ do: 'bend', steps: this.before, select: step.select, at: step.at, t: this.time, nodes: step.nodes });
      if (run !== this.#bending || this.step?.do !== 'drag') return;
      this.#bent = { number: told.number, places: told.places, own: told.own, flight: false, again: false };
      const o = this.overlay, node = place => nearest(told.places, place);
      o.nodes = told.nodes;
      o.pulled = step.handles.map(handle => ({ node: node(handle.place), by: pulledAt(handle, this.time) }));
      o.pinned = (step.pins ?? []).map(pin => node(pin));
      this.say(`${told.nodes.length} nodes${step.nodes ? '' : ' of the model'}.`);
      this.#properties();
      o.redraw();
      if (o.pulled.length) this.#pulling();
    } catch (error) { this.say(error.message, true); }
  }

  get #radius() {
    const places = this.#bent.places, middle = [0, 1, 2].map(k => places.reduce((s, p) => s + p[k], 0) / places.length);
    return round(GRIP * Math.sqrt(places.reduce((s, p) => s + p.reduce((q, x, k) => q + (x - middle[k]) ** 2, 0), 0) / places.length));
  }

  /** Requests the image of what is pulled; while one is on its way, only for the newest. */
  async #pulling() {
    const bent = this.#bent, o = this.overlay;
    if (!bent) return;
    if (bent.flight) { bent.again = true; return; }
    bent.flight = true;
    try {
      do {
        bent.again = false;
        const began = performance.now(), { handles, pins } = this.#held();
        const told = await this.ask({ do: 'pull', number: bent.number, handles, pins, view: this.view(SIDE_PULLING) });
        if (bent !== this.#bent || o.tool !== 'bend') return;
        o.nodes = told.nodes;
        // After a handle is released, the list's own image is requested.
        if (o.busy || this.#standing) {
          if (o.busy) await o.show(told.picture);
        } else await o.show(null);
        this.pullMs = performance.now() - began;
        o.redraw();
      } while (bent.again);
    } catch (error) { this.say(error.message, true); } finally { bent.flight = false; }
  }

  #held() {
    const { places } = this.#bent, radius = this.#radius, old = this.step.handles;
    const handles = this.overlay.pulled.map(({ node, by }) => {
      const known = old.find(k => nearest(places, k.place) === node);
      return { place: known?.place ?? places[node].map(round), radius: known?.radius ?? radius, by };
    });
    return { handles, pins: this.step.pins ?? [] };
  }

  /** A handle was released. */
  #pulled(node) {
    const step = this.step, { places } = this.#bent, one = this.overlay.pulled.find(p => p.node === node);
    const i = step.handles.findIndex(k => nearest(places, k.place) === node);
    const fresh = { place: places[node].map(round), radius: this.#radius, keys: [{ t: round(this.time), by: one.by.map(round) }] };
    const handles = i < 0 ? [...step.handles, fresh] : step.handles.map((k, n) => (n === i ? pulledTo(k, this.time, one.by) : k));
    this.#set({ ...step, handles });
  }

  /** A node was tapped: it is pinned, or released. */
  #pin(node) {
    const step = this.step, { places } = this.#bent, pins = step.pins ?? [];
    const at = list => list.findIndex(k => nearest(places, k.place ?? k) === node);
    const [handle, pin] = [at(step.handles), at(pins)];
    const next = handle >= 0 ? { ...step, handles: step.handles.filter((_, i) => i !== handle) }
      : pin >= 0 ? { ...step, pins: pins.filter((_, i) => i !== pin) }
        : { ...step, pins: [...pins, [...places[node].map(round), this.#radius]] };
    this.#set(next);
    this.overlay.pulled = this.overlay.pulled.filter(p => next.handles.some(k => nearest(places, k.place) === p.node));
    this.overlay.pinned = next.pins.map(k => nearest(places, k));
    this.#pulling();
  }

  destroy() {
    this.ends.forEach(end => end());
    this.overlay.destroy();
    this.panel.remove();
    this.opener.remove();
    clearTimeout(this.#timers.time);
  }
}

/** Number of the place that is nearest to a point. */
function nearest(places, [x, y, z]) {
  let best = 0, least = Infinity;
  places.forEach((p, i) => {
    const d = (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2;
    if (d < least) [best, least] = [i, d];
  });
  return best;
}

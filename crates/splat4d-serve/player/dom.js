// Small builders of page elements. Text is inserted as text, never as markup: titles and names are from foreign files.

import { icon } from './icons.js';

/** Characters that act instead of being shown: control characters but line breaks and tabs, directions of text (UAX #9). */
const ACTING = /[^\P{Cc}\n\t]|[\u061C\u200E\u200F\u2028-\u202E\u2066-\u2069]/gu;

/** Text of a foreign file with such characters spelt out (`\u{202e}`), as the command prints it. */
export const shown = text => String(text).replace(ACTING, c => `\\u{${c.codePointAt(0).toString(16)}}`);

/** An element with properties ('on…' are listeners, others attributes) and children. */
export function h(tag, props = {}, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(props)) {
    if (key.startsWith('on')) node.addEventListener(key.slice(2), value);
    else if (value === true) node.setAttribute(key, '');
    else if (value !== false && value != null) node.setAttribute(key, value);
  }
  node.append(...children.filter(c => c != null).map(c => (typeof c === 'string' ? shown(c) : c)));
  return node;
}

/** A button that is only an icon; its name is for screen readers and the tooltip. */
export function tool(name, label, onclick, props = {}) {
  const own = { type: 'button', class: 'tool', title: label, 'aria-label': label, onclick };
  return h('button', { ...own, ...props }, icon(name));
}

/** Changes an icon button's symbol and name. */
export function retool(button, name, label) {
  if (button.title === label) return;
  button.title = label;
  button.setAttribute('aria-label', label);
  button.replaceChildren(icon(name));
}

/** Disables a button with the reason as its tooltip; no reason enables it and gives it the tooltip of its use. */
export function allow(node, reason, use = '') {
  node.disabled = !!reason;
  node.title = reason || use;
}

export const button = (label, onclick, props = {}, name = null) =>
  h('button', { type: 'button', class: 'soft', onclick, ...props }, name && icon(name), label);

let groups = 0;
/** A choice of one of a few: radio buttons shown as one control. set(value) shows a value. */
export function segments(label, options, onpick, props = {}) {
  const name = `splat4d-${groups++}`;
  const inputs = new Map();
  const node = h('div', { role: 'radiogroup', 'aria-label': label, ...props, class: `seg ${props.class ?? ''}` },
    ...options.map(([value, text, title]) => {
      const own = { type: 'radio', name, value, 'aria-label': text };
      const input = h('input', { ...own, onchange: () => onpick(value) });
      inputs.set(value, input);
      return h('label', { title }, input, h('span', {}, text));
    }));
  node.set = value => { const input = inputs.get(value); if (input) input.checked = true; };
  return node;
}

/** A list to choose from. set(value) shows a value, adding it where it is not among the options. */
export function choice(label, options, onpick, props = {}) {
  const option = ([value, text]) => h('option', { value }, text);
  const node = h('select', { 'aria-label': label, title: label, ...props, onchange: () => onpick(node.value) },
    ...options.map(option));
  node.set = (value, text) => {
    if (![...node.options].some(o => o.value === String(value))) node.append(option([value, text ?? String(value)]));
    node.value = String(value);
  };
  return node;
}

export const field = (label, control, more = '') =>
  h('div', { class: `field ${more}` }, h('span', {}, label), control);

/** m:ss.cc, with hours where the clip has them. */
export function clock(seconds, long) {
  const s = Math.max(0, seconds), hours = Math.floor(s / 3600);
  const minutes = Math.floor(s / 60) % 60, rest = (Math.floor(s * 100 + 1e-6) / 100 % 60).toFixed(2).padStart(5, '0');
  return hours || long >= 3600 ? `${hours}:${String(minutes).padStart(2, '0')}:${rest}` : `${minutes}:${rest}`;
}

export function bytes(n) {
  return n < 1e3 ? `${n} B` : n < 1e6 ? `${(n / 1e3).toFixed(0)} kB` : `${(n / 1e6).toFixed(n < 1e8 ? 1 : 0)} MB`;
}

/** Offers a file for saving. */
export function save(blob, name) {
  const href = URL.createObjectURL(blob);
  h('a', { href, download: name }).click();
  // Long enough for every browser to have begun reading it.
  setTimeout(() => URL.revokeObjectURL(href), 60000);
}

/** Opens the file dialog; nothing happens if it is cancelled. */
export function pick(accept, onfile) {
  const input = h('input', { type: 'file', accept, onchange: () => input.files[0] && onfile(input.files[0]) });
  input.click();
}

/** The token to edit, to control a run or to align cameras, from the address that the program printed. It leaves the address bar and stays for this tab. */
export function leave(right) {
  const kept = f => { try { return f(sessionStorage); } catch { return null; /* Storage may be shut; the address then serves once. */ } };
  const given = new URLSearchParams(location.hash.slice(1)), found = given.get(right);
  if (!found) return kept(s => s.getItem(`splat4d-${right}`));
  given.delete(right);
  kept(s => s.setItem(`splat4d-${right}`, found));
  const rest = decodeURIComponent(given.toString());
  history.replaceState(null, '', location.pathname + location.search + (rest ? `#${rest}` : ''));
  return found;
}

// The page around the element: reads what to show, from the page itself or from the server next to it.

import './element.js';
import { leave, shown } from './dom.js';

async function config() {
  if (globalThis.SPLAT4D_CONFIG) return globalThis.SPLAT4D_CONFIG;
  const inline = document.getElementById('splat4d-config');
  if (inline) return JSON.parse(inline.textContent);
  // A page opened from a disk has no server.
  if (!location.protocol.startsWith('http')) return {};
  try {
    const answer = await fetch('./config.json');
    return answer.ok ? await answer.json() : {};
  } catch { return {}; }
}

const about = await config();
const token = about.edit ? leave('edit') : null, control = about.control ? leave('control') : null;
const element = document.createElement('splat-4d');
element.setAttribute('page', '');
document.body.append(element);
const { scene, src = scene, title, live, metrics, version, cameras, photos, frusta, autoplay = true } = about;
if (cameras) element.face.capture = { cameras, photos: photos ? './photo' : null, overview: frusta };
// A capture is first shown unchanged.
if (autoplay && !token && !frusta && !matchMedia('(prefers-reduced-motion: reduce)').matches) element.setAttribute('autoplay', '');
if (title) {
  element.setAttribute('heading', title);
  document.title = `${shown(title)} · splat4d`;
}
if (live) {
  // A run that has just begun has no snapshot; the first one is announced.
  element.follow({ events: live === true ? './events' : live, src: src ?? './scene.s4d', metrics, version,
    control: control && { address: './control', token: control } });
} else if (src instanceof Blob) element.scene = src;
else if (src) element.setAttribute('src', src);
else element.invite();
if (frusta) element.addEventListener('load', () => element.face.showCameras(true), { once: true });
if (token) {
  element.addEventListener('load', () => import('./edit.js').then(m => m.Editing.start(element.face, token))
    .catch(error => element.face.toast(error.message, 8000)), { once: true });
}
if (new URLSearchParams(location.search).has('measure')) {
  element.addEventListener('load', () => import('./measure.js').then(m => m.report(element)), { once: true });
}

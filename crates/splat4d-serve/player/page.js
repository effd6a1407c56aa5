// The page around the element: reads what to show, from the page itself or from the server beside it.

import './element.js';

async function config() {
  if (globalThis.SPLAT4D_CONFIG) return globalThis.SPLAT4D_CONFIG;
  const inline = document.getElementById('splat4d-config');
  if (inline) return JSON.parse(inline.textContent);
  // A page opened from a disk has no server to ask.
  if (!location.protocol.startsWith('http')) return {};
  try {
    const answer = await fetch('./config.json');
    return answer.ok ? await answer.json() : {};
  } catch { return {}; }
}

const element = document.createElement('splat-4d');
element.setAttribute('page', '');
document.body.append(element);
const { scene, src = scene, title, live, metrics, version, autoplay = true } = await config();
if (autoplay && !matchMedia('(prefers-reduced-motion: reduce)').matches) element.setAttribute('autoplay', '');
if (title) {
  element.setAttribute('heading', title);
  document.title = `${title} · splat4d`;
}
if (live) {
  // A run that has just begun has no snapshot; the first one is announced.
  element.follow({ events: live === true ? './events' : live, src: src ?? './scene.splat4d', metrics, version });
} else if (src instanceof Blob) element.scene = src;
else if (src) element.setAttribute('src', src);
else element.invite();

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

const { scene, src = scene, title, live, metrics, version, autoplay = true } = await config();
const element = document.createElement('splat-4d');
element.setAttribute('page', '');
if (autoplay && !matchMedia('(prefers-reduced-motion: reduce)').matches) element.setAttribute('autoplay', '');
if (title) {
  element.setAttribute('heading', title);
  document.title = `${title} · splat4d`;
}
if (typeof src === 'string' && !live) element.setAttribute('src', src);
document.body.append(element);
if (src instanceof Blob) element.scene = src;
if (live) {
  element.follow({ events: live === true ? './events' : live, src: src ?? './scene.splat4d', metrics, version });
}

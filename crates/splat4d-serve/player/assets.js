// Source of the workers: files next to this one, or blob URLs in the one-file page (`SPLAT4D_ASSETS`).

/// Starts the worker called `name` ('decode.worker.js'), a classic one: a page opened from a disk may start no module
/// workers from blob URLs (Chromium). `start` makes it of its file: `() => new Worker(new URL('./decode.worker.js',
/// import.meta.url))`, written out by the caller, because bundlers search for it. Throws where the page may start no
/// workers.
export function worker(name, start) {
  const given = globalThis.SPLAT4D_ASSETS?.[name];
  if (given) return new Worker(given);
  // In two steps: bundlers that understood this would take every file of the folder. Some write another address than
  // the page's for a module ('file:'): they know theirs.
  const here = import.meta.url,
    url = new URL(name, here);
  if (!url.protocol.startsWith('http') || url.origin === globalThis.location?.origin) return start();
  // A page of another origin embeds the player: a worker must be of its own origin, but may load from elsewhere.
  const text = `importScripts(${JSON.stringify(url.href)});`;
  const blob = URL.createObjectURL(new Blob([text], { type: 'text/javascript' }));
  const made = new Worker(blob);
  setTimeout(() => URL.revokeObjectURL(blob), REVOKE);
  return made;
}

/// Long enough for a worker to have read its few bytes, ms.
const REVOKE = 10_000;

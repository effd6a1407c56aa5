// Where the workers come from: files beside this one, or blob URLs in the one-file page (`SPLAT4D_ASSETS`).

/// Starts the worker called `name` ('decode.worker.js'), a classic one: a page opened from a disk may start no module
/// workers from blob URLs (Chromium). Throws where the page may start no workers.
export function worker(name) {
  const given = globalThis.SPLAT4D_ASSETS?.[name];
  if (given) return new Worker(given);
  const url = new URL('./' + name, import.meta.url);
  if (url.origin === globalThis.location?.origin) return new Worker(url);
  // A page of another origin embeds the player: a worker must be of its own origin, but may load from elsewhere.
  const text = `importScripts(${JSON.stringify(url.href)});`;
  const blob = URL.createObjectURL(new Blob([text], { type: 'text/javascript' }));
  const made = new Worker(blob);
  setTimeout(() => URL.revokeObjectURL(blob), REVOKE);
  return made;
}

/// Long enough for a worker to have read its few bytes, ms.
const REVOKE = 10_000;

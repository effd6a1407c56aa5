// Where the workers come from: files beside this one, or blob URLs in the one-file page (`SPLAT4D_ASSETS`).

/// Starts the worker called `name` ('decode.worker.js'). Throws where the page may not start workers.
export function worker(name) {
  const given = globalThis.SPLAT4D_ASSETS?.[name];
  if (given) return new Worker(given, { type: 'module' });
  const url = new URL('./' + name, import.meta.url);
  if (url.origin === globalThis.location?.origin) return new Worker(url, { type: 'module' });
  // A page of another origin embeds the player: a worker must be of its own origin, but may import from elsewhere.
  const text = `import ${JSON.stringify(url.href)};`;
  const blob = URL.createObjectURL(new Blob([text], { type: 'text/javascript' }));
  const made = new Worker(blob, { type: 'module' });
  URL.revokeObjectURL(blob);
  return made;
}

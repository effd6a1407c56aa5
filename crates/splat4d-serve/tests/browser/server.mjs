// A small server for tests: files of folders and bytes in memory, ranges, and a count of what it sent.

import { createReadStream, statSync } from 'node:fs';
import http from 'node:http';
import path from 'node:path';
import { fileURLToPath } from 'node:url';

export const PLAYER = fileURLToPath(new URL('../../player/', import.meta.url));
/// Bytes that a slow line sends at a time, and how late a busy machine may be, ms.
const PIECE = 8192,
  LATE = 200;
const TYPES = { '.html': 'text/html', '.js': 'text/javascript', '.mjs': 'text/javascript', '.css': 'text/css' };

/// Serves `files` (name → bytes or text) and the folders in `folders` (prefix → folder; the player is at /player/).
/// `ranges: false`: a server without ranges. `delay`: ms before each answer. `fail(request, count)`: true cuts
/// the connection. `rate`: bits per second of all scenes together, 0: unlimited; it may be changed while the server runs
/// (`options.rate`). Returns {url, log: [{url, from, to, status}], sent: bytes of bodies, set(name, bytes), close()}.
export async function serve({ files = {}, folders = {}, ranges = true, delay = 0, fail = () => false, rate = 0 } = {}) {
  const state = { log: [], sent: 0, options: { ranges, delay, fail, rate } };
  let free = 0;
  /// Writes a body piece by piece, when the line is free.
  const slowly = async (response, body) => {
    for (let at = 0; at < body.length && !response.destroyed; at += PIECE) {
      const piece = body.subarray(at, at + PIECE),
        now = performance.now();
      // What a late timer costs is caught up with: the line itself is not slower.
      free = Math.max(free, now - LATE) + (8000 * piece.length) / state.options.rate;
      await new Promise((done) => setTimeout(done, free - now));
      response.write(piece);
    }
    response.end();
  };
  const roots = { '/player/': PLAYER, ...folders };
  const server = http.createServer(async (request, response) => {
    const name = decodeURIComponent(new URL(request.url, 'http://x').pathname),
      { options } = state;
    // What every browser requests by itself.
    if (name === '/favicon.ico') return response.writeHead(204).end();
    if (options.delay) await new Promise((done) => setTimeout(done, options.delay));
    if (options.fail(request, state.log.length)) {
      state.log.push({ url: name, status: 0 });
      return request.socket.destroy();
    }
    const prefix = Object.keys(roots).find((p) => name.startsWith(p));
    let body = files[name.slice(1)] ?? null,
      file = null;
    if (body === null && prefix && !name.includes('..')) file = path.join(roots[prefix], name.slice(prefix.length));
    let size = body === null ? 0 : Buffer.byteLength(body);
    try {
      if (file) size = statSync(file).size;
    } catch {
      file = null;
    }
    if (body === null && !file) {
      state.log.push({ url: name, status: 404 });
      return response.writeHead(404).end();
    }
    const type = TYPES[path.extname(name)] ?? 'application/octet-stream';
    const asked = options.ranges && /^bytes=(\d+)-(\d*)$/.exec(request.headers.range ?? '');
    const headers = {
      'content-type': type,
      'cache-control': 'no-store',
      'accept-ranges': options.ranges ? 'bytes' : 'none',
    };
    let [from, to, status] = [0, size - 1, 200];
    if (asked) {
      [from, to, status] = [Number(asked[1]), Math.min(asked[2] ? Number(asked[2]) : Infinity, size - 1), 206];
      if (from >= size) {
        state.log.push({ url: name, status: 416 });
        return response.writeHead(416, { 'content-range': `bytes */${size}` }).end();
      }
      headers['content-range'] = `bytes ${from}-${to}/${size}`;
    }
    headers['content-length'] = to - from + 1;
    state.log.push({ url: name, from, to, status });
    state.sent += to - from + 1;
    response.writeHead(status, headers);
    const scene = body !== null && options.rate && name.endsWith('.s4d');
    if (scene) slowly(response, Buffer.from(body).subarray(from, to + 1));
    else if (file) createReadStream(file, { start: from, end: to }).pipe(response);
    else response.end(Buffer.from(body).subarray(from, to + 1));
  });
  await new Promise((done) => server.listen(0, '127.0.0.1', done));
  return Object.assign(state, {
    url: `http://127.0.0.1:${server.address().port}/`,
    set: (name, bytes) => (files[name] = bytes),
    close: () => (server.closeAllConnections(), new Promise((done) => server.close(done))),
  });
}

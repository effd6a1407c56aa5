// For the interface's tests: a server with the player's files, stand-ins for what draws and reads, and synthetic live
// events.

import { createServer } from 'node:http';
import { readFile } from 'node:fs/promises';
import { dirname, join } from 'node:path';
import { fileURLToPath } from 'node:url';

const HERE = dirname(fileURLToPath(import.meta.url));
const PLAYER = join(HERE, '../../player');
const TYPES = { js: 'text/javascript', html: 'text/html', json: 'application/json' };

/** One pixel. */
const PNG = Buffer.from('iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg==', 'base64');

/** Serves `/` and the player; `pages` are further routes {path: html}; `config` is /config.json. */
export class Site {
  config = { title: 'Two knights', scene: 'scene.s4d', live: false };
  pages = {};
  listeners = new Set();
  joined = 0;
  /** Requests for images, and for control of a run. */
  photos = [];
  controlled = [];
  mocks = true;

  async start(port = 0) {
    this.server = createServer((request, response) => this.#answer(request, response));
    await new Promise(done => this.server.listen(port, '127.0.0.1', done));
    this.port = this.server.address().port;
    this.url = `http://127.0.0.1:${this.port}/`;
    return this;
  }

  async #answer(request, response) {
    const path = new URL(request.url, this.url).pathname;
    if (path === '/config.json') return this.#send(response, JSON.stringify(this.config), 'json');
    if (this.pages[path]) return this.#send(response, this.pages[path], 'html');
    // What every browser requests by itself.
    if (path === '/favicon.ico') return response.writeHead(204).end();
    if (path === '/events') return this.#listen(response);
    if (path === '/photo') return this.#photo(new URL(request.url, this.url).searchParams, response);
    if (path === '/control') return this.#control(request, response);
    const name = path === '/' ? 'index.html' : path.replace(/^\/(player\/)?/, '');
    for (const folder of this.mocks ? [join(HERE, 'mock'), PLAYER] : [PLAYER]) {
      const text = /^[\w.-]+$/.test(name) && await readFile(join(folder, name)).catch(() => null);
      if (text) return this.#send(response, text, name.split('.').at(-1));
    }
    response.writeHead(404).end();
  }

  #send(response, body, type) {
    response.writeHead(200, { 'content-type': TYPES[type] ?? 'text/plain', 'cache-control': 'no-store' }).end(body);
  }

  /** An image per camera; its time is that of the nearest tenth of a second. */
  #photo(asked, response) {
    this.photos.push(Object.fromEntries(asked));
    const time = Math.round(10 * asked.get('t')) / 10;
    response.writeHead(200, { 'content-type': 'image/png', 'x-splat4d-time': time }).end(PNG);
  }

  async #control(request, response) {
    let body = '';
    for await (const part of request) body += part;
    this.controlled.push({ ...JSON.parse(body), token: request.headers['x-splat4d-token'] });
    this.#send(response, JSON.stringify({ state: { pause: 'pausing', continue: 'training', stop: 'stopping' }[JSON.parse(body).do] }), 'json');
  }

  #listen(response) {
    this.joined++;
    response.writeHead(200, { 'content-type': 'text/event-stream' });
    response.write(':\n\n');
    for (const line of this.history ?? []) response.write(line);
    this.listeners.add(response);
    response.on('close', () => this.listeners.delete(response));
  }

  say(data, keep = true) {
    const line = `data: ${JSON.stringify(data)}\n\n`;
    if (keep) (this.history ??= []).push(line);
    for (const r of this.listeners) r.write(line);
  }

  /** Cuts all event streams, as a lost network does. */
  cut() { for (const r of this.listeners) r.destroy(); }

  async stop() {
    this.server.closeAllConnections();
    await new Promise(done => this.server.close(done));
  }
}

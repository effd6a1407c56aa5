// Bytes of a source by offset: HTTP ranges of a URL (adjacent ones in one request, few at a time, again after a
// network error), or slices of what is in memory already.

import { SceneError } from './errors.js';
import { Throughput } from './ladder.js';

/// Requests at a time: what browsers open to one host over HTTP/1.1.
const PARALLEL = 6;
/// Longest request that is put together from several sections, bytes: longer ones would keep what is needed first
/// waiting on one connection while others idle.
const RUN = 1 << 20;
/// Unwanted bytes between two sections that cost less than a request of their own.
const GAP = 2048;
/// Pause before the one repetition, ms.
const PAUSE = 300;

/// What is in memory, or a Blob: the same interface as `Remote`.
export class Local {
  bytesRead = 0;
  constructor(source) {
    this.blob = source instanceof Blob ? source : null;
    this.bytes = this.blob
      ? null
      : ArrayBuffer.isView(source)
        ? new Uint8Array(source.buffer, source.byteOffset, source.byteLength)
        : new Uint8Array(source);
    this.size = this.blob ? this.blob.size : this.bytes.length;
  }
  async read(offset, length, signal) {
    signal?.throwIfAborted();
    const end = Math.min(offset + length, this.size);
    this.bytesRead += Math.max(0, end - offset);
    if (this.bytes) return this.bytes.slice(offset, end);
    try {
      return new Uint8Array(await this.blob.slice(offset, end).arrayBuffer());
    } catch (e) {
      throw new SceneError(
        'The file could not be read',
        this.blob.name,
        'If it was moved or changed, choose it again.',
        e,
      );
    }
  }
  /// Bits per second: what is here needs no connection.
  rate() {
    return Infinity;
  }
  close() {}
}

/// A URL. `open` makes the first request and detects whether the server supports ranges.
export class Remote {
  bytesRead = 0;
  /// Length of the whole, bytes; Infinity where the server hides it (Content-Range is not shown across origins).
  size = Infinity;
  #queue = [];
  #running = 0;
  #closed = new AbortController();
  #memory = null;
  #throughput = new Throughput();

  #observer = null;

  constructor(url) {
    this.url = url;
    const name = new URL(url, globalThis.location?.href).href;
    if (!globalThis.PerformanceObserver?.supportedEntryTypes?.includes('resource')) return;
    this.#observer = new PerformanceObserver((list) => {
      for (const e of list.getEntries()) {
        // Of another origin, a server may hide the times.
        if (e.name === name && e.encodedBodySize > 0 && e.requestStart > 0) {
          this.#throughput.timed(e.encodedBodySize, e.requestStart, e.responseStart, e.responseEnd);
        }
      }
    });
    this.#observer.observe({ type: 'resource' });
  }

  /// Reads the first `length` bytes; from a server without ranges the whole. `onprogress(read, total)` then.
  async open(length, signal, onprogress) {
    this.#throughput.begin(performance.now());
    try {
      return await this.#twice(async () => {
        const response = await this.#request(0, length, signal);
        if (response.status === 206) {
          const total = Number(/\/(\d+)$/.exec(response.headers.get('content-range') ?? '')?.[1]);
          if (total) this.size = total;
          return this.#body(response, null, length);
        }
        // 200: the server sends everything, so everything is read, once.
        const expected = Number(response.headers.get('content-length')) || 0;
        this.#memory = await this.#body(response, (n) => onprogress?.(n, expected));
        this.size = this.#memory.length;
        return this.#memory.slice(0, length);
      }, signal);
    } catch (e) {
      if (signal?.aborted || e instanceof SceneError) throw e;
      const local = /^file:/.test(new URL(this.url, globalThis.location?.href).protocol);
      throw new SceneError(
        'The scene could not be fetched',
        this.url,
        local
          ? 'Browsers do not read files next to a page opened from disk. Open the scene with the file button, or serve the folder.'
          : 'Check the address and the connection. A server of another origin must allow access (CORS).',
        e,
      );
    } finally {
      this.#throughput.end(performance.now());
    }
  }

  read(offset, length, signal) {
    if (this.#memory) return Promise.resolve(this.#memory.slice(offset, offset + length));
    return new Promise((resolve, reject) => {
      if (signal?.aborted || this.#closed.signal.aborted) {
        return reject(signal?.reason ?? this.#closed.signal.reason);
      }
      const job = { offset, length, resolve, reject, done: false, stop: null };
      job.leave = () => {
        job.done = true;
        reject(signal?.reason ?? new DOMException('closed', 'AbortError'));
        job.stop?.();
      };
      job.settle = () => {
        job.done = true;
        signal?.removeEventListener('abort', job.leave);
      };
      signal?.addEventListener('abort', job.leave, { once: true });
      this.#queue.push(job);
      // In a microtask, so that ranges requested together can share a request.
      queueMicrotask(() => this.#next());
    });
  }

  /// Bits per second of the connection while it is busy; 0 before anything was measured.
  rate(now) {
    return this.#memory ? Infinity : this.#throughput.rate(now);
  }

  close() {
    this.#observer?.disconnect();
    this.#closed.abort();
    for (const job of this.#queue.splice(0)) if (!job.done) job.leave();
  }

  #next() {
    while (this.#running < PARALLEL && this.#queue.length) {
      const first = this.#queue.shift();
      if (first.done) continue;
      const run = [first];
      for (let grown = true, end = first.offset + first.length; grown;) {
        const i = this.#queue.findIndex(
          (j) => !j.done && j.offset >= end && j.offset <= end + GAP && j.offset + j.length - first.offset <= RUN,
        );
        grown = i >= 0;
        if (grown) {
          const [job] = this.#queue.splice(i, 1);
          run.push(job);
          end = job.offset + job.length;
        }
      }
      this.#running++;
      this.#fetch(run).finally(() => {
        this.#running--;
        this.#next();
      });
    }
  }

  /// Fetches jobs that lie behind one another, in one request; each resolves as soon as its bytes arrived.
  async #fetch(run) {
    const stop = new AbortController();
    const leave = () => stop.abort();
    this.#closed.signal.addEventListener('abort', leave);
    for (const job of run) job.stop = () => run.every((j) => j.done) && stop.abort();
    this.#throughput.begin(performance.now());
    try {
      await this.#twice(async () => {
        const open = run.filter((j) => !j.done);
        if (!open.length) return;
        const offset = open[0].offset,
          last = open[open.length - 1];
        const length = last.offset + last.length - offset;
        const response = await this.#request(offset, length, stop.signal);
        if (response.status !== 206) {
          response.body?.cancel().catch(() => {});
          throw new SceneError('The server stopped answering range requests', this.url, 'Reload the page.');
        }
        const answer = (bytes, read) => {
          for (const job of open) {
            const at = job.offset - offset;
            if (job.done || at + job.length > read) continue;
            job.settle();
            job.resolve(bytes.slice(at, at + job.length));
          }
        };
        const bytes = await this.#body(response, null, length, answer);
        if (bytes.length < length) throw new TypeError('the connection ended early');
      }, stop.signal);
    } catch (e) {
      const error =
        e instanceof SceneError || stop.signal.aborted
          ? e
          : new SceneError('The connection failed', this.url, 'The player continues when the connection is back.', e);
      for (const job of run) {
        if (!job.done) {
          job.settle();
          job.reject(error);
        }
      }
    } finally {
      this.#throughput.end(performance.now());
      this.#closed.signal.removeEventListener('abort', leave);
    }
  }

  /// Runs `work` again once where it failed for the network's sake.
  async #twice(work, signal) {
    try {
      return await work();
    } catch (e) {
      if (signal?.aborted || (e instanceof SceneError && !e.transient)) throw e;
      await new Promise((done) => setTimeout(done, PAUSE));
      signal?.throwIfAborted();
      return work();
    }
  }

  async #request(offset, length, signal) {
    // no-store: a browser's cache makes parallel ranges of one address wait for each other (Chromium's cache lock).
    const range = `bytes=${offset}-${offset + length - 1}`;
    const response = await fetch(this.url, { headers: { Range: range }, signal, cache: 'no-store' });
    if (response.status === 200 || response.status === 206) return response;
    response.body?.cancel().catch(() => {});
    const error = new SceneError(
      response.status === 416
        ? 'The file is shorter than its index states, or empty'
        : `The server answered ${response.status} ${response.statusText}`.trimEnd(),
      this.url,
      response.status === 404 ? 'Check the address.' : '',
    );
    error.transient = response.status >= 500 || response.status === 429;
    throw error;
  }

  /// All bytes of a response, at most `limit` where one is given.
  async #body(response, progress, limit = 0, answer = null) {
    const reader = response.body.getReader();
    let bytes = new Uint8Array(limit || 1 << 16),
      n = 0;
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return bytes.subarray(0, n);
      this.bytesRead += value.length;
      this.#throughput.add(value.length, performance.now());
      const more = limit ? value.subarray(0, limit - n) : value;
      if (n + more.length > bytes.length) {
        const grown = new Uint8Array(Math.max(n + more.length, 2 * bytes.length));
        grown.set(bytes.subarray(0, n));
        bytes = grown;
      }
      bytes.set(more, n);
      n += more.length;
      progress?.(n);
      answer?.(bytes, n);
      if (more.length < value.length) {
        // It sends more than requested: the rest is not read.
        reader.cancel().catch(() => {});
        return bytes;
      }
    }
  }
}

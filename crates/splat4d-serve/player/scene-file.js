// A playback file (docs/format.md), read in parts: index, pages, key masks, palettes, poster, sound. Trusts no number of
// it.

import { worker } from './assets.js';
import { NEAR } from './camera.js';
import './decode.worker.js';
import { SceneError, isAbort } from './errors.js';
import { Local, Remote } from './ranges.js';

const { crc32, decode } = globalThis.splat4dDecode;

/// First request, bytes: header and index of most files, and often the poster.
const FIRST = 65536;
/// Sizes of docs/format.md.
const HEAD = 64,
  ENTRY = 64,
  BLOCK = 256,
  BLOCK_BYTES = 96,
  WORDS = 8;
const MAGIC = [0x89, 0x53, 0x34, 0x44, 0x0d, 0x0a, 0x1a, 0x0a];
/// A finished file, and one that grows: its index is behind the listed sections.
const MAJOR = 1,
  GROWING = 2;
const MAX_INDEX = 64 << 20,
  MAX_SECTIONS = 1e6,
  MAX_COUNT = 65536,
  MAX_KEYS = 65535,
  NO_PALETTE = 0xffffffff;
/// Deflate shrinks at most 1 : 1032 (RFC 1951: 258 bytes from two bits).
const DEFLATE_RATIO = 1032;
/// Masks that unpack to more than this, and to more than this many times the file, are refused (docs/format.md).
const SMALL_MASK = 64 << 20,
  MASK_RATIO = 64;
/// A poster larger than this is no preview, bytes.
const MAX_POSTER = 32 << 20;
/// More sound is refused, bytes; and what its bytes 4 to 7 are.
const MAX_SOUND = 64 << 20,
  MP4 = 'ftyp';
/// A file that grows is looked at again after this time, ms: its header is 64 bytes.
const GROWTH = 2000;
/// Workers: inflating a page takes some ms, and the network is slower than two.
const WORKERS = (globalThis.navigator?.hardwareConcurrency ?? 2) > 2 ? 2 : 1;

const DAMAGED = 'Fetch or bake it again.';

/// Decodes in workers, or on this thread where the page may start none.
class Decoder {
  #workers = [];
  #waiting = new Map();
  #ticket = 0;
  #here = typeof Worker === 'undefined';

  run(job) {
    const lane = this.#here ? null : this.#lane();
    if (!lane) return decode(job);
    return new Promise((resolve, reject) => {
      const ticket = ++this.#ticket;
      this.#waiting.set(ticket, { resolve, reject, job, lane });
      lane.load++;
      // Copied, not moved: if the worker turns out not to start, the job is done here.
      lane.worker.postMessage({ ticket, job }, lane.proven ? [job.stored.buffer] : []);
    });
  }

  /// Starts a worker before there is work: that takes as long as the first request.
  warm() {
    if (!this.#here) this.#lane();
  }

  close() {
    for (const { worker } of this.#workers) worker.terminate();
    this.#workers = [];
    for (const { reject } of this.#waiting.values()) reject(new DOMException('closed', 'AbortError'));
    this.#waiting.clear();
  }

  #lane() {
    const idle = this.#workers.find((w) => w.load === 0);
    if (idle || this.#workers.length >= WORKERS) {
      return idle ?? this.#workers.reduce((a, b) => (b.load < a.load ? b : a));
    }
    try {
      const started = worker('decode.worker.js', () => new Worker(new URL('./decode.worker.js', import.meta.url)));
      const lane = { worker: started, load: 0, proven: false };
      lane.worker.onmessage = ({ data: { ticket, result, error } }) => {
        lane.proven = true;
        lane.load--;
        const waiting = this.#waiting.get(ticket);
        this.#waiting.delete(ticket);
        if (error) waiting?.reject(new Error(error));
        else waiting?.resolve(result);
      };
      lane.worker.onerror = (event) => {
        event.preventDefault?.();
        this.#fall(lane);
      };
      this.#workers.push(lane);
      return lane;
    } catch {
      this.#here = true;
      return null;
    }
  }

  /// A worker that did not start (a page's policy may forbid it): its work is done here.
  #fall(lane) {
    this.#here = true;
    for (const [ticket, w] of [...this.#waiting]) {
      if (w.lane !== lane) continue;
      this.#waiting.delete(ticket);
      if (lane.proven) w.reject(new Error('the decoder stopped unexpectedly'));
      else decode(w.job).then(w.resolve, w.reject);
    }
    this.#workers = this.#workers.filter((l) => l !== lane);
    lane.worker.terminate();
  }
}

/// One playback file. Make it with `SceneFile.open`.
export class SceneFile {
  /// Opens a URL (text or URL object), a Blob or an ArrayBuffer. `onprogress(read, total)` is called while a server
  /// without range requests sends the whole file. Throws SceneError.
  static async open(source, { signal, onprogress } = {}) {
    const file = new SceneFile();
    const remote = typeof source === 'string' || source instanceof URL;
    file.#where = remote ? String(source) : source?.name || 'the file';
    file.#source = remote ? new Remote(String(source)) : new Local(source);
    file.#decoder.warm();
    try {
      const read = (length) =>
        remote ? file.#source.open(length, signal, onprogress) : file.#source.read(0, length, signal);
      await file.#start(await read(FIRST), signal);
    } catch (e) {
      file.close();
      throw e;
    }
    return file;
  }

  /// The JSON of the index, checked: every key of docs/format.md, those that are not there null or empty.
  meta;
  /// All sections: {id, kind, flags, offset, stored, bytes, crc, codec, tier, degree, count, words, from, to,
  /// palette: id or -1, missing: behind the end of a file that was cut short; of a page: mask: id or -1, maskBytes: of
  /// that mask when it is decoded}.
  sections = [];
  /// The sections of kind PAGE that are there.
  pages = [];
  /// Whether the file was cut short.
  truncated = false;
  /// Whether it is of a clip that is not finished: there may be more of it later.
  growing = false;
  #source;
  #where;
  #head;
  #decoder = new Decoder();
  #timer = 0;

  /// Bytes from the network or the disk.
  get bytesRead() {
    return this.#source.bytesRead;
  }

  /// Bits per second of its connection; 0 before anything was measured, Infinity where all of it is in memory.
  rate(now) {
    return this.#source.rate(now);
  }

  /// Length of the file, bytes.
  bytesTotal = 0;
  /// Bytes that the file states it has: more than there are where it was cut short.
  length = 0;

  /// Fetches, checks and decodes page `id`: {id, count, headers: Float32Array(24·blocks), words: Uint32Array(8·count),
  /// word w of Gaussian i at [8i + w]}.
  async page(id, { signal } = {}) {
    const entry = this.sections[id];
    return { id, ...(await this.#decoded(entry, signal, this.sections[entry.palette]?.count ?? 0)) };
  }

  /// The same for a palette: {id, degree, count, ranges: Float32Array(3), bytes: its planes}.
  async palette(id, { signal } = {}) {
    return { id, ...(await this.#decoded(this.sections[id], signal, 0)) };
  }

  /// The same for the key masks of a page, `id` its `mask`: {id, count, keys: Float64Array, rows: Uint32Array,
  /// stride: words a key}.
  async mask(id, { signal } = {}) {
    return { id, ...(await this.#decoded(this.sections[id], signal, 0)) };
  }

  /// The labels of a page, `id` its `labels`: a byte a Gaussian, 255: it has none.
  async labels(id, { signal } = {}) {
    return (await this.#decoded(this.sections[id], signal, 0)).bytes;
  }

  /// The poster as a Blob, or null.
  async poster({ signal } = {}) {
    const entry = this.sections.find((s) => s.kind === 'POST' && !s.missing);
    if (!entry || entry.bytes > MAX_POSTER || entry.stored > MAX_POSTER) return null;
    const { bytes } = await this.#decoded(entry, signal, 0);
    return new Blob([bytes], { type: bytes[0] === MAGIC[0] ? 'image/png' : 'image/jpeg' });
  }

  /// The sound: {blob, span: its first and last second on the scene's clock}, or null.
  async sound({ signal } = {}) {
    const entry = this.sections.find((s) => s.kind === 'SOUN' && !s.missing);
    if (!entry) return null;
    const { bytes } = await this.#decoded(entry, signal, 0);
    if (String.fromCharCode(...bytes.subarray(4, 8)) !== MP4) this.#refuse(`Section ${entry.id} (SOUN) is not an MP4 file`);
    return { blob: new Blob([bytes], { type: 'audio/mp4' }), span: [entry.from, entry.to] };
  }

  /// `time` held inside the clip.
  clamp(time) {
    const [first, last] = this.meta.clip;
    return Math.min(Math.max(time, first), last);
  }

  /// The pages that are drawn at `time`.
  activePages(time) {
    const t = this.clamp(time);
    return this.pages.filter((p) => p.from <= t && t < p.to);
  }

  /// Whether a truncated file lost pages that are drawn at `time`.
  lacks(time) {
    const t = this.clamp(time);
    return this.sections.some((s) => s.kind === 'PAGE' && s.missing && s.from <= t && t < s.to);
  }

  /// Calls `more()` whenever a file that grows has become longer by its header, which is read again every `every` ms,
  /// until the file is closed.
  watch(more, every = GROWTH) {
    if (!this.growing) return;
    this.#timer = setTimeout(async () => {
      const timer = this.#timer;
      // Without a connection there is nothing new, for now.
      const head = await this.#source.read(0, HEAD).catch(() => []);
      if (timer !== this.#timer) return;
      if (head.length === HEAD && long(new DataView(head.buffer, head.byteOffset), 16) !== this.length) more();
      if (timer === this.#timer) this.watch(more, every);
    }, every);
  }

  close() {
    clearTimeout(this.#timer);
    this.#timer = 0;
    this.#source.close();
    this.#decoder.close();
  }

  async #decoded(entry, signal, labels) {
    const { kind, offset, stored, crc, codec, bytes, count, degree, id, missing, from, to } = entry;
    const where = `${this.#where}, section ${id}`;
    if (missing) throw new SceneError('The file is truncated before this section', where, DAMAGED);
    const data = await this.#bytes(offset, stored, signal);
    signal?.throwIfAborted();
    try {
      if (data.length !== stored) throw new Error('the file ends before the section');
      return await this.#decoder.run({ kind, stored: data, crc, codec, bytes, count, degree, labels, from, to });
    } catch (e) {
      if (isAbort(e)) throw e;
      throw new SceneError(`A section of the scene cannot be read: ${e.message}`, where, DAMAGED, e);
    }
  }

  /// Bytes of the file; what the first request brought is not fetched again.
  async #bytes(offset, length, signal) {
    const known = this.#head.slice(offset, offset + length);
    if (known.length === length) return known;
    const rest = await this.#source.read(offset + known.length, length - known.length, signal);
    if (!known.length) return rest;
    const data = new Uint8Array(known.length + rest.length);
    data.set(known);
    data.set(rest, known.length);
    return data;
  }

  #refuse(what, remedy = DAMAGED) {
    throw new SceneError(what, this.#where, remedy);
  }

  async #start(head, signal) {
    if (head.length < HEAD || MAGIC.some((b, i) => head[i] !== b)) {
      this.#refuse('Not a .s4d file', 'Bake or convert the scene to .s4d first.');
    }
    const view = new DataView(head.buffer, head.byteOffset, head.byteLength);
    if (view.getUint32(60, true) !== crc32(head.subarray(0, 60)))
      this.#refuse('The header is damaged: its checksum differs');
    const major = view.getUint16(8, true);
    if (major !== MAJOR && major !== GROWING) {
      this.#refuse(`The file has version ${major}, this player reads ${MAJOR}`, 'Use a newer player.');
    }
    const indexBytes = view.getUint32(12, true);
    const length = long(view, 16);
    this.length = length;
    this.growing = major === GROWING;
    const at = this.growing ? long(view, 28) : HEAD;
    this.bytesTotal = Math.min(length, this.#source.size);
    this.truncated = this.#source.size < length;
    if (indexBytes > MAX_INDEX || !(at >= HEAD && at + indexBytes <= length)) this.#refuse('The index is longer than allowed');
    this.#head = head;
    const whole = at + indexBytes <= this.bytesTotal;
    const index = whole ? await this.#bytes(at, indexBytes, signal) : [];
    if (index.length !== indexBytes) this.#refuse('The file is truncated in its index');
    if (crc32(index) !== view.getUint32(24, true)) this.#refuse('The index is damaged: its checksum differs');
    this.#index(index, at, length);
  }

  #index(index, at, length) {
    const view = new DataView(index.buffer, index.byteOffset, index.byteLength);
    const jsonBytes = index.length >= 8 ? view.getUint32(0, true) : NO_PALETTE;
    if (jsonBytes % 4 || jsonBytes > index.length - 8) this.#refuse('The index does not contain its description');
    let json;
    try {
      json = JSON.parse(new TextDecoder('utf-8', { fatal: true }).decode(index.subarray(4, 4 + jsonBytes)));
    } catch {
      this.#refuse("The scene's description is not valid JSON");
    }
    const table = 8 + jsonBytes,
      count = view.getUint32(4 + jsonBytes, true);
    if (count > MAX_SECTIONS || index.length !== table + count * ENTRY) {
      this.#refuse(`The index is not a table of ${count} sections`);
    }
    this.meta = this.#checkedMeta(json);
    for (let id = 0; id < count; id++) this.sections.push(this.#entry(view, table + id * ENTRY, id, length));
    const order = [...this.sections, { id: 'index', offset: at, stored: index.length }];
    order.sort((a, b) => a.offset - b.offset);
    for (let i = 1; i < order.length; i++) {
      if (order[i].offset < order[i - 1].offset + order[i - 1].stored) {
        this.#refuse(`Sections ${order[i - 1].id} and ${order[i].id} overlap`);
      }
    }
    for (const page of this.sections) {
      if (page.kind !== 'PAGE') continue;
      const palette = this.sections[page.palette];
      if (page.palette !== -1 && palette?.kind !== 'PALT') this.#refuse(`Page ${page.id} refers to no palette`);
      // Without its palette a page cannot be drawn.
      if (palette?.missing) page.missing = true;
      if (!page.missing) this.pages.push(page);
    }
    for (const mask of this.sections) {
      if (mask.kind !== 'MASK') continue;
      const page = this.sections[mask.page];
      if (page?.kind !== 'PAGE') this.#refuse(`Mask ${mask.id} refers to no page`);
      if (page.count !== mask.count) {
        this.#refuse(`Mask ${mask.id} is for ${mask.count} Gaussians, its page ${page.id} has ${page.count}`);
      }
      if (page.mask !== -1) this.#refuse(`Page ${page.id} has two masks`);
      // A file that was cut short behind a page shows the page without its mask.
      if (mask.missing) continue;
      page.mask = mask.id;
      page.maskBytes = mask.keys * 4 * Math.ceil(mask.count / 32);
    }
    for (const labels of this.sections) {
      if (labels.kind !== 'LABL') continue;
      const page = this.sections[labels.page];
      if (page?.kind !== 'PAGE' || page.count !== labels.count) {
        this.#refuse(`Labels ${labels.id} refer to no page of ${labels.count} Gaussians`);
      }
      if (page.labels !== -1) this.#refuse(`Page ${page.id} has labels twice`);
      if (!labels.missing) page.labels = labels.id;
    }
    // The pages determine what is rendered, not the description.
    this.meta.gaussians = this.pages.reduce((n, p) => n + p.count, 0);
  }

  #entry(view, at, id, length) {
    const u32 = (o) => view.getUint32(at + o, true);
    const kind = String.fromCharCode(...[0, 1, 2, 3].map((i) => view.getUint8(at + i)));
    const [offset, stored, bytes] = [long(view, at + 8), u32(16), u32(20)];
    const [codec, level, count] = [view.getUint16(at + 28, true), view.getUint16(at + 30, true), u32(32)];
    const section = { id, kind, flags: u32(4), offset, stored, bytes, crc: u32(24), codec, count };
    Object.assign(section, { tier: level, degree: level, words: u32(36), from: view.getFloat64(at + 40, true) });
    Object.assign(section, { to: view.getFloat64(at + 48, true), palette: u32(56) === NO_PALETTE ? -1 : u32(56) });
    section.missing = offset + stored > this.bytesTotal;
    const refuse = (what, remedy) => this.#refuse(`Section ${id} (${kind.replace(/[^ -~]/g, '?')}) ${what}`, remedy);
    if (!(offset >= HEAD && offset + stored <= length)) refuse('lies outside the file');
    if (!['PAGE', 'PALT', 'POST', 'MASK', 'LABL', 'SOUN'].includes(kind)) {
      if (section.flags & 1) refuse('is of a kind that this player does not support', 'Use a newer player.');
      return section;
    }
    if (codec > 1) refuse(`has the unknown compression method ${codec}`, 'Use a newer player.');
    if (codec === 0 ? stored !== bytes : bytes > DEFLATE_RATIO * stored) refuse('cannot have the stated size');
    if (kind === 'POST') return section;
    if (kind === 'SOUN') {
      if (codec !== 0 || bytes > MAX_SOUND) refuse(`has ${bytes} bytes, expected at most ${MAX_SOUND}, uncompressed`);
      if (!(section.from < section.to && Number.isFinite(section.to - section.from))) refuse('has no valid time range');
      return section;
    }
    if (count < 1 || count > MAX_COUNT) refuse(`has ${count} entries, expected 1 to ${MAX_COUNT}`);
    if (kind === 'MASK') {
      this.#checkMask(section, u32(56), refuse);
      return section;
    }
    if (kind === 'LABL') {
      Object.assign(section, { page: u32(56), palette: -1 });
      if (bytes !== count) refuse(`decodes to ${bytes} bytes, expected one for each of ${count} Gaussians`);
      return section;
    }
    if (kind === 'PAGE') Object.assign(section, { mask: -1, maskBytes: 0, labels: -1 });
    if (kind === 'PAGE' && section.words !== WORDS) {
      refuse(`has ${section.words} words per Gaussian, expected ${WORDS}`, 'Use a newer player.');
    }
    if (kind === 'PALT' && !(level >= 1 && level <= 3)) refuse(`has degree ${level}, expected 1 to 3`);
    const right =
      kind === 'PAGE'
        ? Math.ceil(count / BLOCK) * BLOCK_BYTES + 4 * WORDS * count
        : 12 + 3 * ((level + 1) ** 2 - 1) * count;
    if (bytes !== right) refuse(`decodes to ${bytes} bytes, expected ${right} for ${count} entries`);
    // Deflate stores what it cannot shrink with few bytes more; twice is nothing that a writer makes.
    if (stored > 2 * bytes) refuse('is longer compressed than uncompressed');
    if (kind === 'PAGE' && !(section.from < section.to && Number.isFinite(section.to - section.from))) {
      refuse('has no valid time range');
    }
    return section;
  }

  /// Key masks: a row of bits each of as many key times as its size bears out.
  #checkMask(section, page, refuse) {
    const { count, bytes, stored, from, to } = section;
    const keys = (bytes - 8) / (8 + Math.ceil(count / 8));
    Object.assign(section, { page, palette: -1, keys });
    if (!(Number.isInteger(keys) && keys >= 1 && keys <= MAX_KEYS)) {
      refuse(`decodes to ${bytes} bytes, which fit no number of key times for ${count} Gaussians`);
    }
    if (stored > 2 * bytes) refuse('is longer compressed than uncompressed');
    if (bytes > SMALL_MASK && bytes > MASK_RATIO * this.bytesTotal) refuse(`decompresses to ${bytes} bytes, more than allowed`);
    if (!(from <= to && Number.isFinite(to - from))) refuse('has no valid time range');
  }

  #checkedMeta(json) {
    const need = (ok, key) => ok || this.#refuse(`The scene's description has no valid "${key}"`);
    const text = (v) => (typeof v === 'string' ? v : null);
    const j = json ?? {};
    need(numbers(j.clip, 2) && j.clip[0] <= j.clip[1], 'clip');
    need(number(j.fps) && j.fps > 0, 'fps');
    need(numbers(j.up, 3) && Math.hypot(...j.up) > 0.5, 'up');
    need(numbers(j.background, 3), 'background');
    need([0, 1, 2, 3].includes(j.sh_degree), 'sh_degree');
    need(Number.isSafeInteger(j.gaussians) && j.gaussians >= 0, 'gaussians');
    const box = Array.isArray(j.box) && j.box.length === 2 && j.box.every((c) => numbers(c, 3)) ? j.box : null;
    const up = j.up.map((v) => v / Math.hypot(...j.up));
    const cameras = list(j.cameras)
      .filter(camera)
      .map((c, i) => ({ ...c, name: text(c.name) ?? `camera ${i + 1}` }));
    const nears = cameras.map((c) => c.near).filter((v) => number(v) && v > 0);
    return {
      clip: [...j.clip],
      fps: j.fps,
      up,
      background: j.background.map((v) => Math.min(Math.max(v, 0), 1)),
      sh_degree: j.sh_degree,
      gaussians: j.gaussians,
      unit: number(j.unit) && j.unit > 0 ? j.unit : null,
      title: text(j.title),
      generator: text(j.generator),
      box,
      view: look(j.view) ? j.view : null,
      cameras,
      labels: list(j.labels).filter((name) => typeof name === 'string').slice(0, 255),
      ladder: ladder(j.ladder),
      missing: list(j.missing).filter((span) => numbers(span, 2) && span[0] < span[1]),
      near: nears.length ? Math.min(...nears) : NEAR,
      path: list(j.path)
        .filter((k) => look(k) && number(k.at))
        .map((k) => ({ ...k, time: number(k.time) ? k.time : null })),
    };
  }
}

const number = (v) => typeof v === 'number' && Number.isFinite(v);
const numbers = (v, n) => Array.isArray(v) && v.length === n && v.every(number);
const list = (v) => (Array.isArray(v) ? v : []);
const look = (v) =>
  v &&
  numbers(v.position, 3) &&
  numbers(v.target, 3) &&
  numbers(v.up, 3) &&
  number(v.fov_y) &&
  v.fov_y > 0 &&
  v.fov_y < 180;
const camera = (v) =>
  v &&
  numbers(v.world_from_camera, 12) &&
  number(v.cx) &&
  number(v.cy) &&
  [v.width, v.height, v.fx, v.fy].every((n) => number(n) && n > 0);

/// Rungs with rising rates and tiers; none where they are not.
function ladder(v) {
  const rungs = list(v).map((r) => ({ rate: r?.rate, tiers: r?.tiers }));
  const rises = rungs.every(({ rate, tiers }, k) => {
    const last = rungs[k - 1] ?? { rate: 0, tiers: 0 };
    return number(rate) && Number.isInteger(tiers) && rate > last.rate && tiers > last.tiers;
  });
  return rises ? rungs : [];
}

/// A u64, as a float: beyond 2⁵³ it is no length that exists, and fails the comparison with what is there.
function long(view, at) {
  return view.getUint32(at, true) + view.getUint32(at + 4, true) * 2 ** 32;
}

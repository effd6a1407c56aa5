// From the stored bytes of a section to what a backend needs: checks the CRC, inflates, transposes byte planes into
// words, and key masks into rows of bits.
//
// A classic script that is also a module, and so without imports and exports: a page opened from a disk may start
// classic workers from blob URLs, but no modules. What a page needs of it is in `globalThis.splat4dDecode`.
'use strict';

/// Gaussians a block header describes, and its f32 numbers (docs/format.md).
const BLOCK = 256,
  HEADER = 24;
/// 32-bit words a Gaussian (docs/format.md).
const WORDS = 8;
/// Bytes given to the inflater at a time. A browser inflates a piece whole, at most 1 : 1032, before it can be stopped
/// it: so a hostile section costs 16 MB and no more.
const PIECE = 16384;

/// Where the platform is big endian, the typed arrays below would read nonsense; no browser runs on one.
const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; k++) n = n & 1 ? (n >>> 1) ^ 0xedb88320 : n >>> 1;
  return n;
});

/// CRC-32 (IEEE 802.3, as in zip) of bytes.
function crc32(bytes) {
  let c = ~0;
  for (let i = 0; i < bytes.length; i++) c = CRC_TABLE[(c ^ bytes[i]) & 255] ^ (c >>> 8);
  return ~c >>> 0;
}

/// Inflates `stored` (RFC 1951) to exactly `bytes` bytes; throws when there are more or fewer.
async function inflate(stored, bytes) {
  const stream = new DecompressionStream('deflate-raw');
  const writer = stream.writable.getWriter(),
    reader = stream.readable.getReader();
  const feed = (async () => {
    for (let i = 0; i < stored.length; i += PIECE) await writer.write(stored.subarray(i, i + PIECE));
    await writer.close();
  })();
  // The reader meets the same error and reports it; here it must only not go unhandled.
  feed.catch(() => {});
  const out = new Uint8Array(bytes);
  let at = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    if (at + value.length > bytes) {
      reader.cancel().catch(() => {});
      throw new Error(`it decompresses to more than the ${bytes} bytes stated in the index`);
    }
    out.set(value, at);
    at += value.length;
  }
  if (at !== bytes) throw new Error(`it decompresses to ${at} bytes, expected ${bytes} as in the index`);
  return out;
}

function finite(numbers, what) {
  for (let i = 0; i < numbers.length; i++) {
    if (!Number.isFinite(numbers[i])) throw new Error(`${what} ${i} is not finite`);
  }
}

/// Transposes the 32 byte planes of `count` Gaussians, from byte `at` on, into words: word w of i is [8i + w].
function transpose(data, at, count) {
  const words = new Uint32Array(WORDS * count);
  for (let w = 0; w < WORDS; w++) {
    const a = at + 4 * w * count,
      b = a + count,
      c = b + count,
      d = c + count;
    for (let i = 0, o = w; i < count; i++, o += WORDS) {
      words[o] = data[a + i] | (data[b + i] << 8) | (data[c + i] << 16) | (data[d + i] << 24);
    }
  }
  return words;
}

function page(data, { count, labels }) {
  const start = Math.ceil(count / BLOCK) * HEADER * 4;
  const headers = new Float32Array(data.slice(0, start).buffer);
  finite(headers, 'number of the block headers');
  const words = transpose(data, start, count);
  for (let i = 0; labels && i < count; i++) {
    const label = words[WORDS * i + 7] & 0xffff;
    if (label >= labels) throw new Error(`Gaussian ${i} refers to entry ${label} of a palette of ${labels}`);
  }
  return { count, headers, words };
}

function palette(data, { count, degree }) {
  const ranges = new Float32Array(data.slice(0, 12).buffer);
  finite(ranges, 'range');
  return { degree, count, ranges, bytes: data.slice(12) };
}

/// Key masks of a page: {count, keys: their times, rows: Uint32Array, `stride` words a key, bit i % 32 of word
/// ⌊i / 32⌋ is Gaussian i}. In the file a row is the difference to the one before, bytes without padding.
function mask(data, { count, from, to }) {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const packed = Math.ceil(count / 8),
    stride = Math.ceil(count / 32),
    number = data.length >= 8 ? view.getUint32(0, true) : 0;
  const right = 8 + number * (8 + packed);
  if (number < 1 || data.length !== right) throw new Error(`not a mask of ${number} key times`);
  const keys = Float64Array.from({ length: number }, (_, k) => view.getFloat64(8 + 8 * k, true));
  finite(keys, 'key time');
  if (keys.some((t, k) => k && !(keys[k - 1] < t))) throw new Error('its key times are not increasing');
  if (keys[0] !== from || keys[number - 1] !== to) throw new Error('its key times differ from the index');
  const bytes = new Uint8Array(4 * stride * number);
  for (let k = 0, at = 8 + 8 * number; k < number; k++) {
    const row = 4 * stride * k;
    for (let i = 0; i < packed; i++, at++) bytes[row + i] = data[at] ^ (k ? bytes[row - 4 * stride + i] : 0);
    // Bits beyond the last Gaussian mean nothing, and are not counted.
    if (count % 8) bytes[row + packed - 1] &= (1 << (count % 8)) - 1;
  }
  return { count, keys, rows: new Uint32Array(bytes.buffer), stride };
}

/// Decodes one section.
///
/// `job`: {kind 'PAGE' | 'PALT' | 'MASK' | other: bytes as they are, stored Uint8Array, crc, codec, bytes, count,
/// degree, labels: entries of the page's palette, 0: none, from, to}. Its sizes have been checked against the file.
/// Throws an Error that states why.
async function decode(job) {
  if (crc32(job.stored) !== job.crc) throw new Error('its bytes are damaged: the checksum differs');
  let data = job.stored;
  if (job.codec === 1) {
    try {
      data = await inflate(job.stored, job.bytes);
    } catch (e) {
      // The platform's own texts ("The compressed data was not valid") name no culprit.
      throw e instanceof TypeError || e?.code ? new Error('its compressed bytes are not valid') : e;
    }
  }
  if (job.kind === 'PAGE') return page(data, job);
  if (job.kind === 'PALT') return palette(data, job);
  if (job.kind === 'MASK') return mask(data, job);
  return { bytes: data };
}

globalThis.splat4dDecode = { crc32, decode };

if (typeof WorkerGlobalScope !== 'undefined' && self instanceof WorkerGlobalScope) {
  self.onmessage = async ({ data: { ticket, job } }) => {
    try {
      const result = await decode(job);
      const arrays = Object.values(result).filter((a) => ArrayBuffer.isView(a));
      const move = arrays.map((a) => a.buffer);
      self.postMessage({ ticket, result }, move);
    } catch (e) {
      self.postMessage({ ticket, error: e.message });
    }
  };
}

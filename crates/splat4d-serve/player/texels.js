// What WebGL2 textures hold of pages and palettes, for the backend and for scenes inside other renderers.

import { BATCH, BLOCK_TEXELS } from './glsl.js';
import './sort.worker.js';

const { ROW } = globalThis.splat4dSort;

/// Texels across the words' and the palettes' textures: every WebGL2 device has them (its minimum for a texture).
export const WIDTH = 2048;
/// Gaussians a block, f32 numbers of a header (docs/format.md).
const BLOCK = 256,
  HEADER = 24;
/// Texels across the blocks' texture: the blocks of a row of words.
export const BLOCKS_WIDTH = (ROW / BLOCK) * BLOCK_TEXELS;
/// Header numbers that are times on the scene clock: life centre min and max, alive from and to.
const TIMES = [6, 7, 8, 9];
/// x/z and y/z inside J may leave the image by this share of its half-width's tangent (CONVENTIONS.md).
export const J_MARGIN = 0.3;
/// Two triangles of a quad's four corners.
const CORNERS = [0, 1, 2, 2, 1, 3];

/// Indices of the quads of one instance.
export const corners = () => Uint16Array.from({ length: 6 * BATCH }, (_, i) => 4 * Math.floor(i / 6) + CORNERS[i % 6]);

/// A page's block headers as `rows` rows of texels. `palette` {row, degree, ranges}: position of its palette, if it has
/// one.
export function blockTexels(headers, rows, { from, to }, palette, start) {
  const texels = new Float32Array(rows * BLOCKS_WIDTH * 4);
  const { row, degree, ranges } = palette ?? { row: -1, degree: 0, ranges: [0, 0, 0] };
  for (let b = 0; b * HEADER < headers.length; b++) {
    const o = b * BLOCK_TEXELS * 4,
      h = headers.subarray(b * HEADER, (b + 1) * HEADER);
    texels.set(h, o);
    // Relative to the clip's start, so that 32 bits keep their precision on a clock that started long ago.
    for (const k of TIMES) texels[o + k] = h[k] - start;
    texels.set([from - start, to - start, row, degree, ...ranges, to - from], o + HEADER);
  }
  return texels;
}

/// A palette from planes (coefficient, channel) to `rows` rows of texels: one coefficient of an entry each, entry by
/// entry.
export function paletteTexels(per, count, bytes, rows) {
  const texels = new Uint8Array(rows * WIDTH * 4);
  for (let k = 0; k < per; k++) {
    for (let c = 0; c < 3; c++) {
      const plane = (3 * k + c) * count;
      for (let i = 0; i < count; i++) texels[(i * per + k) * 4 + c] = bytes[plane + i];
    }
  }
  return texels;
}

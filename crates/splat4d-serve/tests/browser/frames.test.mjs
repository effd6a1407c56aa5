// The arrays of `splat4d/frames`, as npm delivers it, against the conformance set of the format. Needs no browser.

import assert from 'node:assert/strict';
import { cpSync, mkdtempSync, readFileSync, readdirSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath, pathToFileURL } from 'node:url';

const here = (name) => fileURLToPath(new URL(name, import.meta.url));
const SET = here('../../../../clients/conformance/');
/// Of 1 + |number|, as the set states it.
const TOLERANCE = 1e-5;

const work = mkdtempSync(path.join(tmpdir(), 'splat4d-frames-'));
test.after(() => rmSync(work, { recursive: true }));
// As in the package, where the player's modules lie next to it.
cpSync(here('../../player'), path.join(work, 'player'), { recursive: true });
cpSync(here('../../npm/frames.js'), path.join(work, 'frames.js'));
writeFileSync(path.join(work, 'package.json'), '{"type":"module"}');
const { Frames } = await import(pathToFileURL(path.join(work, 'frames.js')));

const close = (a, b) => Math.abs(a - b) <= TOLERANCE * (1 + Math.abs(b));

/// The numbers of Gaussian i, in the order of the set.
function numbers(g, i) {
  const [x, y, z, w] = g.rotation.subarray(4 * i, 4 * i + 4),
    three = (array) => [...array.subarray(3 * i, 3 * i + 3)];
  return [...three(g.position), w, x, y, z, ...three(g.scale), g.opacity[i], ...three(g.color)];
}

/// Whether Gaussian i has the requested numbers; a rotation may have the other sign.
function same(g, i, wanted) {
  const have = numbers(g, i),
    sign = [3, 4, 5, 6].reduce((sum, k) => sum + have[k] * wanted[k], 0) < 0 ? -1 : 1;
  return have.every((x, k) => close(k >= 3 && k < 7 ? sign * x : x, wanted[k]));
}

for (const file of readdirSync(SET).filter((name) => name.endsWith('.json'))) {
  const want = JSON.parse(readFileSync(path.join(SET, file)));
  test(`the arrays of ${want.file}: ${want.about}`, async () => {
    const bytes = readFileSync(path.join(SET, want.file));
    const frames = new Frames(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
    await frames.ready;
    for (const { time, rendered, gaussians } of want.at) {
      await frames.load(time);
      const g = frames.at(time, want.eye);
      assert.equal(g.count, rendered, `Gaussians at ${time}`);
      assert.ok(g.count <= frames.capacity);
      for (const [page, row, ...wanted] of gaussians) {
        let found = false;
        for (let i = 0; i < g.count && !found; i++) found = same(g, i, wanted);
        assert.ok(found, `Gaussian ${row} of section ${page} at ${time}`);
      }
    }
    frames.dispose();
  });
}

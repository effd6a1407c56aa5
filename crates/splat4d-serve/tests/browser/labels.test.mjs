// Labels: read from a file, and pages as they are shown by label.

import assert from 'node:assert/strict';
import test from 'node:test';
import { labelColor, painted } from '../../player/labels.js';
import { gaussian } from './motion.js';
import { SceneFile } from '../../player/scene-file.js';
import { layout, sample } from './sample.mjs';

/** The sample with labels of its first page: 0, 1, none in turn. */
function labelled(change = () => {}) {
  const { sections, json } = sample();
  const page = sections.findIndex((s) => s.kind === 'PAGE');
  const bytes = Buffer.from(Array.from({ length: sections[page].count }, (_, i) => [0, 1, 255][i % 3]));
  const section = { kind: 'LABL', data: bytes, count: bytes.length, page };
  change(section, sections);
  return new Blob([layout({ ...json, labels: ['floor', 'hand'] }, [...sections, section])]);
}

test('labels are read and belong to their page', async () => {
  const file = await SceneFile.open(labelled());
  assert.deepEqual(file.meta.labels, ['floor', 'hand']);
  const page = file.pages.find((p) => p.labels >= 0);
  assert.deepEqual([...(await file.labels(page.labels)).slice(0, 4)], [0, 1, 255, 0]);
  await assert.rejects(SceneFile.open(labelled((s) => (s.count -= 1))), /one for each|no page/);
});

test('a label alone, and labels as colours', async () => {
  const file = await SceneFile.open(labelled());
  const entry = file.pages.find((p) => p.labels >= 0),
    page = await file.page(entry.id),
    labels = await file.labels(entry.labels);
  const [alone] = painted(page, entry, labels, { colors: false, only: 1 });
  const [colored, shown] = painted(page, entry, labels, { colors: true, only: null });
  assert.equal(shown.palette, -1);
  for (let i = 0; i < 6; i++) {
    const was = gaussian(page, entry, i);
    assert.equal(gaussian(alone, entry, i).opacity, i % 3 === 1 ? was.opacity : 0);
    assert.deepEqual(gaussian(alone, entry, i).color, was.color);
    const now = gaussian(colored, shown, i),
      want = i % 3 === 2 ? 0x808080 : labelColor(i % 3);
    now.color.forEach((c, k) => assert.ok(Math.abs(255 * c - ((want >> (8 * k)) & 255)) < 1e-3));
    assert.deepEqual([now.half, now.opacity, now.mean], [was.half, was.opacity, was.mean]);
  }
});

// Replaces the reader of playback files in the interface's tests: a synthetic scene of six pages, which arrive
// late on purpose. The address states what to do: `broken` fails, `slow` takes its time, `still` has one time only.

import { SceneError } from './errors.js';

const wait = ms => new Promise(done => setTimeout(done, ms));
const PAGES = 6, COUNT = 400;

export class SceneFile {
  rate() { return Infinity; }

  static async open(source, { signal } = {}) {
    const name = typeof source === 'string' ? source : source.name ?? 'bytes';
    globalThis.mockOpened = [...(globalThis.mockOpened ?? []), name];
    await wait(name.includes('slow') ? 1500 : 20);
    signal?.throwIfAborted();
    if (name.includes('broken')) {
      throw new SceneError('The index is damaged: its checksum differs', name, 'Fetch or bake it again.');
    }
    const file = new SceneFile();
    file.name = name;
    const span = name.includes('still') ? 0 : 4;
    file.meta = {
      clip: [1, 1 + span], fps: 25, up: [0, 1, 0], background: [0.93, 0.94, 0.95], sh_degree: 0,
      gaussians: PAGES * COUNT, unit: null, title: 'Two knights', box: [[-1, 0, -1], [1, 2, 1]],
      view: { position: [0, 1.6, 4.5], target: [0, 1, 0], up: [0, 1, 0], fov_y: 40 },
      cameras: [0, 1, 2].map(k => ({
        name: `cam0${k}`, width: 800, height: 600, fx: 900, fy: 900, cx: 400, cy: 300,
        // Looks along -z, +x and +z in turn, from 4 units away.
        world_from_camera: [[1, 0, 0, 0, 0, -1, 0, 1, 0, 0, -1, 4], [0, 0, 1, -4, 0, -1, 0, 1, 1, 0, 0, 0],
          [-1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 1, -4]][k],
      })),
      path: [],
    };
    file.pages = Array.from({ length: PAGES }, (_, id) => ({ id, tier: 0, count: COUNT,
      from: 1 + span * id / PAGES, to: id === PAGES - 1 ? 2 + span : 1 + span * (id + 1) / PAGES }));
    if (!span) file.pages = [{ id: 0, tier: 0, count: COUNT, from: 1, to: 2 }];
    file.bytesRead = 4096;
    file.bytesTotal = 4096 + PAGES * 12800;
    return file;
  }

  async page(id) {
    await wait(this.name.includes('slow') ? 1200 : 40);
    this.bytesRead += 12800;
    return { id, count: COUNT };
  }

  watch() {}
  async poster() { return null; }
  async sound() { return globalThis.mockSound ?? null; }
  activePages(t) { return this.pages.filter(p => p.from <= t && t < p.to); }
  close() {}
}

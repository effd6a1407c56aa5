// Replaces the streaming in the interface's tests: pages of now, then the next, then nothing.

export class Stream {
  #here = new Set();
  #asked = new Set();
  constructor(file, backend, { onchange, onerror } = {}) { Object.assign(this, { file, backend, onchange, onerror }); }
  update(time) {
    const now = this.file.activePages(time);
    for (const page of [...now, ...this.file.pages.filter(p => p.from > time).slice(0, 1)]) {
      if (this.#asked.has(page.id)) continue;
      this.#asked.add(page.id);
      this.file.page(page.id).then(p => {
        this.backend.addPage(p, page);
        this.#here.add(page.id);
        this.onchange?.();
      }, this.onerror);
    }
  }
  ready(time) { return this.file.activePages(time).every(p => this.#here.has(p.id)) ? 1 : 0; }
  playable(time) { return this.ready(time) === 1; }
  buffered(points) {
    const [first, last] = this.file.meta.clip, out = [];
    for (let i = 0; i < points; i++) {
      const [a, b] = [i / points, (i + 1) / points];
      if (!this.playable(first + (a + b) / 2 * (last - first))) continue;
      if (out.at(-1)?.[1] === a) out.at(-1)[1] = b;
      else out.push([a, b]);
    }
    return out;
  }
  shown() { return { rung: 0, left: 0 }; }
  rungs() { return null; }
  async settled(time) { while (!this.ready(time)) await new Promise(done => setTimeout(done, 10)); }
  destroy() {}
}

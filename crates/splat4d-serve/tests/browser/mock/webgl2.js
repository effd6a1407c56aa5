// Replaces a backend in the interface's tests: a cloud of dots in a 2D canvas that turns with time.

const DOTS = 2400;

export class WebGL2Backend {
  name = 'webgl2';
  stats = { resident: 0, active: 0, drawn: 0, sortMs: 0.4, drawMs: 1.2 };
  static async create(canvas) {
    const backend = new WebGL2Backend();
    backend.canvas = canvas;
    backend.g = canvas.getContext('2d', { willReadFrequently: true });
    return backend;
  }
  setScene(meta) { this.meta = meta; this.stats.resident = 0; this.shown = null; }
  addPalette() {}
  addPage(page) { this.stats.resident += page.count; }
  dropPage() {}
  resize(width, height) { Object.assign(this.canvas, { width, height }); }
  draw({ time, epoch, view, channel, background }) {
    this.shown = { time, epoch };
    const { g } = this, m = view.cameraFromWorld;
    const css = c => `rgb(${c.map(x => Math.round(255 * x)).join()})`;
    g.fillStyle = channel === 'color' ? css(background) : '#000';
    g.fillRect(0, 0, view.width, view.height);
    for (let i = 0; i < DOTS; i++) {
      const a = i * 2.399963 + 0.4 * (time - 1), h = i / DOTS, r = 0.75 * Math.sin(Math.PI * h) ** 0.6;
      const p = [r * Math.cos(a), 2 * h, r * Math.sin(a)];
      const [x, y, z] = [0, 4, 8].map(k => m[k] * p[0] + m[k + 1] * p[1] + m[k + 2] * p[2] + m[k + 3]);
      if (z < 0.05) continue;
      g.fillStyle = channel === 'color' ? `hsl(${200 + 90 * h} 45% ${38 + 24 * Math.cos(a)}%)`
        : `hsl(0 0% ${100 - 15 * z}%)`;
      g.beginPath();
      g.arc(view.fx * x / z + view.cx, view.fy * y / z + view.cy, 0.016 * view.fx / z, 0, 7);
      g.fill();
    }
    this.stats.drawn = this.stats.active = DOTS;
    this.drawn = { time, channel, view };
  }
  async settled() {}
  async readPixels() {
    const { width, height } = this.canvas;
    return { width, height, data: this.g.getImageData(0, 0, width, height).data };
  }
  destroy() {}
}

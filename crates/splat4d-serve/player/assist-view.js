// An image of a camera with what was clicked in it: zoom, pan, pinch, clicks. Positions are pixels of the image.

/** A press that moves less, CSS pixels, is a click. */
const STILL = 5;
/** A press so near to the active point's mark moves the mark, CSS pixels. */
const GRIP = 14;
/** Largest zoom, CSS pixels of a pixel. */
const MOST = 24;

export class View {
  /** onput(pixel): a click or a moved mark; mark(): the active mark's pixel; paint(view): draws over the image. */
  constructor(canvas, width, height, { onput, mark, paint }) {
    Object.assign(this, { canvas, width, height, onput, mark, paint, image: null, scale: 0, x: 0, y: 0 });
    this.presses = new Map();
    canvas.addEventListener('pointerdown', e => this.#down(e));
    canvas.addEventListener('pointermove', e => this.#move(e));
    canvas.addEventListener('pointerup', e => this.#up(e));
    canvas.addEventListener('pointercancel', e => this.#up(e, true));
    canvas.addEventListener('wheel', e => {
      e.preventDefault();
      this.zoom(Math.exp(-e.deltaY * (e.deltaMode ? 0.05 : 0.0016)), this.#at(e));
    }, { passive: false });
    new ResizeObserver(() => this.resize()).observe(canvas);
  }

  /** The whole image, in the middle. */
  fit() {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    this.scale = Math.min(w / this.width, h / this.height) || 1;
    this.x = (w - this.scale * this.width) / 2;
    this.y = (h - this.scale * this.height) / 2;
  }

  resize() {
    const { canvas } = this, dense = devicePixelRatio || 1;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight].map(v => Math.max(1, Math.round(v * dense)));
    if (canvas.width !== w || canvas.height !== h) Object.assign(canvas, { width: w, height: h });
    if (!this.moved) this.fit();
    this.draw();
  }

  show(image) {
    this.image = image;
    this.draw();
  }

  /** Of a pixel of the image its place in the canvas, CSS pixels; and the inverse. */
  place([x, y]) { return [this.x + this.scale * x, this.y + this.scale * y]; }
  pixel([x, y]) { return [(x - this.x) / this.scale, (y - this.y) / this.scale]; }

  zoom(by, [x, y]) {
    const least = Math.min(this.canvas.clientWidth / this.width, this.canvas.clientHeight / this.height);
    const next = Math.min(MOST, Math.max(least, this.scale * by)), factor = next / this.scale;
    Object.assign(this, { scale: next, x: x - factor * (x - this.x), y: y - factor * (y - this.y), moved: next > least * 1.001 });
    if (!this.moved) this.fit();
    this.draw();
  }

  draw() {
    cancelAnimationFrame(this.waiting);
    this.waiting = requestAnimationFrame(() => {
      const { canvas, image } = this, c = canvas.getContext('2d'), dense = devicePixelRatio || 1;
      c.setTransform(dense, 0, 0, dense, 0, 0);
      c.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
      c.imageSmoothingEnabled = this.scale < 3;
      if (image) c.drawImage(image, this.x, this.y, this.scale * this.width, this.scale * this.height);
      this.paint(this, c);
    });
  }

  #at(e) {
    const box = this.canvas.getBoundingClientRect();
    return [e.clientX - box.left, e.clientY - box.top];
  }

  #down(e) {
    if (e.button) return;
    this.canvas.setPointerCapture(e.pointerId);
    this.canvas.focus();
    const at = this.#at(e), mark = this.mark();
    const near = mark && Math.hypot(...this.place(mark).map((v, k) => v - at[k])) < GRIP;
    this.presses.set(e.pointerId, { from: at, at, grip: near ? mark.map((v, k) => v - this.pixel(at)[k]) : null });
    // A second finger zooms: neither of them clicks.
    if (this.presses.size > 1) this.presses.forEach(p => { p.still = false; p.grip = null; });
    else this.presses.get(e.pointerId).still = true;
  }

  #move(e) {
    const press = this.presses.get(e.pointerId);
    if (!press) return;
    const at = this.#at(e), before = press.at;
    press.at = at;
    if (Math.hypot(at[0] - press.from[0], at[1] - press.from[1]) > STILL) press.still = false;
    if (this.presses.size === 2) {
      const other = [...this.presses.entries()].find(([id]) => id !== e.pointerId)[1].at;
      const apart = p => Math.hypot(p[0] - other[0], p[1] - other[1]);
      const middle = p => [(p[0] + other[0]) / 2, (p[1] + other[1]) / 2];
      this.x += middle(at)[0] - middle(before)[0];
      this.y += middle(at)[1] - middle(before)[1];
      this.zoom(apart(at) / Math.max(1, apart(before)), middle(at));
    } else if (press.grip && !press.still) {
      this.held = this.pixel(at).map((v, k) => v + press.grip[k]);
      this.draw();
    } else if (!press.still) {
      this.x += at[0] - before[0];
      this.y += at[1] - before[1];
      this.moved = true;
      this.draw();
    }
  }

  #up(e, cancelled = false) {
    const press = this.presses.get(e.pointerId), { held } = this;
    this.presses.delete(e.pointerId);
    this.held = null;
    if (!press || cancelled) return this.draw();
    const put = held ?? (press.still ? this.pixel(press.at) : null);
    if (put && put[0] >= 0 && put[1] >= 0 && put[0] <= this.width && put[1] <= this.height) this.onput(put);
    else this.draw();
  }
}

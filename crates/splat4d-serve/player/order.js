// The order in which Gaussians are rendered, computed by a worker; on this thread where the page may start none.

import { worker } from './assets.js';
import './sort.worker.js';

const { Sorter } = globalThis.splat4dSort;

/// One order is on its way at a time. schedule.js decides which one is requested and when.
export class Order {
  /// Counts added and dropped pages, and masks; an order carries the number it was computed with.
  generation = 0;
  /// Whether an order is on its way.
  busy = false;
  #onorder;
  #near;
  #worker = null;
  #sorter = null;
  /// [message, what moves with it], until the worker states that it runs: a page's policy may forbid workers.
  #early = [];
  /// The arrays that are passed back and forth.
  #spare = [];

  /// `onorder({orders, active, left, ms, generation})`: the first `count` of the `order` of each requested view are the
  /// Gaussians that are visible at the requested time, the farthest first; valid during the call only. `left`: those
  /// that the fovea leaves out.
  constructor(near, onorder) {
    this.#near = near;
    this.#onorder = onorder;
    try {
      this.#worker = worker('sort.worker.js', () => new Worker(new URL('./sort.worker.js', import.meta.url)));
    } catch {
      return void this.#here();
    }
    this.#worker.onmessage = ({ data }) => {
      if (!data.ready) return this.#arrived(data);
      const early = this.#early;
      this.#early = null;
      for (const [message, move] of early) this.#worker.postMessage(message, move);
    };
    this.#worker.onerror = (event) => {
      if (!this.#early) return;
      event.preventDefault?.();
      this.#here();
    };
  }

  /// A page whose arrays are the order's from now on, and its first row in the texture.
  add({ id, count, words, headers }, { from, to, tier }, row) {
    this.generation++;
    this.#tell({ add: { id, row, count, words, headers, from, to, tier } }, [words.buffer, headers.buffer]);
  }

  drop(id) {
    this.generation++;
    this.#tell({ drop: id });
  }

  /// Key masks of a page, whose arrays are the order's from now on.
  mask(page, { keys, rows, stride }) {
    this.generation++;
    this.#tell({ page, mask: { keys, rows, stride } }, [keys.buffer, rows.buffer]);
  }

  /// Requests the orders at `time` seen by `views` (camera from world, 3x4); none may be on its way. `fovea`: of
  /// fovea.js, or null.
  ask(time, views, fovea = null) {
    this.busy = true;
    const spare = this.#spare,
      sort = { time, views: views.map((m) => [...m]), near: this.#near, fovea };
    this.#spare = [];
    this.#tell({ sort, generation: this.generation, spare }, spare.map((array) => array.buffer));
  }

  destroy() {
    this.#onorder = () => {};
    this.#worker?.terminate();
  }

  #tell(message, move = []) {
    if (this.#sorter) this.#answer(message);
    else if (this.#early) this.#early.push([message, move]);
    else this.#worker.postMessage(message, move);
  }

  #here() {
    this.#worker?.terminate();
    this.#sorter = new Sorter();
    for (const [message] of this.#early.splice(0)) this.#answer(message);
  }

  #answer({ add, drop, page, mask, sort, generation, spare }) {
    if (add) return this.#sorter.add(add);
    if (drop !== undefined) return this.#sorter.drop(drop);
    if (mask) return this.#sorter.mask(page, mask);
    const begin = performance.now();
    const { orders, active, left } = this.#sorter.orders(sort, spare);
    const ms = performance.now() - begin;
    // Later, like a worker's result: the caller has finished its own work then.
    setTimeout(() => this.#arrived({ orders, active, left, ms, generation }), 0);
  }

  #arrived(answer) {
    this.busy = false;
    this.#spare = answer.orders.map((o) => o.order);
    this.#onorder(answer);
  }
}

// Replaces WebGPU in the interface's tests: a browser that has none, so that the choice falls through.

export class WebGPUBackend {
  static async create() { throw new Error('no adapter'); }
}

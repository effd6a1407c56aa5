// Small things around WebGL2: textures, programs, errors, and rows of a texture to lend.

import { SceneError } from './errors.js';

/// Rows of a texture, lent in runs.
export class Rows {
  #free = [];
  constructor(rows) {
    this.rows = 0;
    this.grow(rows);
  }
  grow(rows) {
    this.give(this.rows, rows - this.rows);
    this.rows = rows;
  }
  /// First row of `count` free ones, or -1.
  take(count) {
    const i = this.#free.findIndex((run) => run.count >= count);
    if (i < 0) return -1;
    const run = this.#free[i],
      row = run.row;
    run.row += count;
    run.count -= count;
    if (!run.count) this.#free.splice(i, 1);
    return row;
  }
  give(row, count) {
    this.#free.push({ row, count });
    this.#free.sort((a, b) => a.row - b.row);
    this.#free = this.#free.reduce((runs, run) => {
      const last = runs[runs.length - 1];
      if (last && last.row + last.count === run.row) last.count += run.count;
      else runs.push(run);
      return runs;
    }, []);
  }
}

/// A texture of one level, not filtered.
export function texture(gl, format, width, height) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  for (const p of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, p, gl.NEAREST);
  return made;
}

/// A linked program and the places of its uniforms.
export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = (gl.getAttachedShaders(made) ?? []).map((s) => gl.getShaderInfoLog(s)).join(' ');
    throw new SceneError(
      "The graphics driver rejects the player's shaders",
      (gl.getProgramInfoLog(made) + logs).slice(0, 500),
      'Update the browser or the driver.',
    );
  }
  const at = {};
  for (let i = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS) - 1; i >= 0; i--) {
    const { name } = gl.getActiveUniform(made, i);
    at[name] = gl.getUniformLocation(made, name);
  }
  return { program: made, at };
}

/// Throws where the driver ran out of memory.
export function check(gl, what) {
  for (let e = gl.getError(); e !== gl.NO_ERROR && e !== gl.CONTEXT_LOST_WEBGL; e = gl.getError()) {
    if (e === gl.OUT_OF_MEMORY) throw new SceneError(what, '', 'Close other pages, or open a smaller scene.');
    throw new SceneError(`The graphics driver reports error ${e}`, '', 'Update the browser or the driver.');
  }
}

/// Measures how long the graphics processor works between `begin` and `end`, where the browser reports it.
export class Timer {
  /// The latest result, ms; 0 where there is none.
  ms = 0;
  #gl;
  #extension;
  #query = null;
  #open = false;
  constructor(gl) {
    this.#gl = gl;
    this.#extension = gl.getExtension('EXT_disjoint_timer_query_webgl2');
  }
  begin() {
    const gl = this.#gl;
    if (!this.#extension) return;
    if (this.#query) {
      // One at a time: results arrive frames later.
      if (!gl.getQueryParameter(this.#query, gl.QUERY_RESULT_AVAILABLE)) return;
      const valid = !gl.getParameter(this.#extension.GPU_DISJOINT_EXT);
      if (valid) this.ms = gl.getQueryParameter(this.#query, gl.QUERY_RESULT) / 1e6;
      gl.deleteQuery(this.#query);
    }
    this.#query = gl.createQuery();
    this.#open = true;
    gl.beginQuery(this.#extension.TIME_ELAPSED_EXT, this.#query);
  }
  end() {
    if (this.#open) this.#gl.endQuery(this.#extension.TIME_ELAPSED_EXT);
    this.#open = false;
  }
}

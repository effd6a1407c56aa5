// One error type for the user: what happened, where, and what to do about it (the twin of splat4d's error.rs).

export class SceneError extends Error {
  constructor(what, where = '', remedy = '', cause = undefined) {
    super(`${what}${where ? ` (${where})` : ''}.${remedy ? ` ${remedy}` : ''}`, { cause });
    this.name = 'SceneError';
    Object.assign(this, { what, where, remedy });
  }
}

/// Whether `error` only states that the result is no longer requested.
export function isAbort(error) {
  return error?.name === 'AbortError';
}

/** A file that ends before its length: an upload or a copy that broke off. */
export function cutShort({ bytesTotal, length }, source) {
  const where = typeof source === 'string' ? source : source?.name;
  return new SceneError(`The file is truncated: ${bytesTotal} of ${length} bytes, some Gaussians are missing`,
    where || 'the file', 'Copy or export the file again.');
}

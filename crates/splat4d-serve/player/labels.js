// Labels of Gaussians (docs/format.md, "Labels") as colours, or one label alone: pages are changed on
// their way to the backend, which does not handle labels.

/// 32-bit words a Gaussian, Gaussians a block, f32 numbers of its header (docs/format.md).
const WORDS = 8,
  BLOCK = 256,
  HEADER = 24;
/// The byte of a Gaussian without a label.
const NONE = 255;
/// Turn of the hue from one label to the next: the golden section, as in `splat4d render --channel label`.
const GOLDEN = 0.618034;
const GREY = 0x808080;

/// A label's colour, red in the lowest byte.
export function labelColor(label) {
  const turn = (label * GOLDEN) % 1,
    saturation = label % 2 ? 0.45 : 0.75,
    value = 0.95;
  const channel = (n) => {
    const k = (n + 6 * turn) % 6;
    return Math.round(255 * (value - value * saturation * Math.min(Math.max(Math.min(k, 4 - k), 0), 1)));
  };
  return channel(5) | (channel(3) << 8) | (channel(1) << 16);
}

/// The same as text for style sheets.
export function labelCss(label) {
  const c = labelColor(label);
  return `rgb(${c & 255} ${(c >> 8) & 255} ${c >> 16})`;
}

/// A page and its entry as they are to be shown. `labels`: a byte per Gaussian, or null: none has one. `show`: {colors:
/// each label in its colour, only: the number of the label that alone is seen, or null}.
export function painted(page, entry, labels, show) {
  const words = page.words.slice();
  const headers = show.colors ? page.headers.slice() : page.headers;
  for (let block = 0; show.colors && block * BLOCK < page.count; block++) {
    headers.fill(0, HEADER * block + 18, HEADER * block + 21);
    headers.fill(1, HEADER * block + 21, HEADER * block + 24);
  }
  for (let i = 0; i < page.count; i++) {
    const label = labels ? labels[i] : NONE;
    // Opacity 0 is not drawn.
    if (show.only !== null && label !== show.only) words[WORDS * i + 2] &= 0xffffff;
    if (show.colors) {
      const color = label === NONE ? GREY : labelColor(label);
      words[WORDS * i + 6] = (words[WORDS * i + 6] & 0xff000000) | color;
    }
  }
  return [{ ...page, words, headers }, show.colors ? { ...entry, palette: -1 } : entry];
}

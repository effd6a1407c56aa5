// `?measure` of the page: how many Gaussians this device renders and how fast, as a row of the table in docs/ladder.md.

/** Seconds before the measurement, in which pages arrive and shaders are compiled, and of the measurement. */
const BEFORE = 2, SECONDS = 10;
/** How long the row is shown, ms. */
const SHOWN = 600_000;

/** The row: device (its GPU, to be completed by a reader), browser, rung, Gaussians, frames per second. */
function row({ player }, headset, frames, seconds) {
  const { drawn, foveated, ladder, width, height } = player.statistics, { gl } = player.backend;
  const info = gl?.getExtension('WEBGL_debug_renderer_info');
  const gpu = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : 'GPU unknown';
  const brand = navigator.userAgentData?.brands.at(-1), browser = brand ? `${brand.brand} ${brand.version}` : navigator.userAgent;
  const size = headset ? `headset${foveated ? ', edges thinned' : ''}` : `${width}×${height}`;
  const cells = [`${size}, ${gpu}`, browser, ladder?.rate?.toFixed(2) ?? 'whole', drawn.toLocaleString('en-GB'), (frames / seconds).toFixed(1)];
  return `| ${cells.map(cell => cell.replaceAll('|', '/')).join(' | ')} |`;
}

/**
 * Measures an element now, in the screen's own pixels, and later in each session of a headset. `shown(row)` gets each row;
 * resolves with the first one.
 */
export async function measure(element, shown = () => {}, { before = BEFORE, seconds = SECONDS } = {}) {
  const { player } = element, wait = s => new Promise(done => setTimeout(done, 1000 * s));
  const run = async headset => {
    await wait(before);
    const { frames } = player.figures, from = performance.now();
    await wait(seconds);
    const made = row(element, headset, player.figures.frames - frames, (performance.now() - from) / 1000);
    console.info(made);
    shown(made);
    return made;
  };
  player.addEventListener('immersed', ({ detail }) => detail.on && run(true));
  player.resolution = 1;
  player.loop = true;
  if (player.still) player.playFilm({ frozen: true });
  else player.play();
  return run(false);
}

/** Measures the page's element and shows the rows. */
export const report = element => measure(element, text => element.face.toast(text, SHOWN));

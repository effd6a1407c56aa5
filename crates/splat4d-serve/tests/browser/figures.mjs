// Measures what docs/python.md and docs/player.md state of installing: from an empty folder to a scene that plays in
// Chromium. PLAYWRIGHT=FOLDER node figures.mjs [WHEEL]; with a wheel also an environment for it, by python3.

import { execFileSync, spawn } from 'node:child_process';
import { mkdtempSync, readFileSync, readdirSync, rmSync, statSync } from 'node:fs';
import { tmpdir } from 'node:os';
import path from 'node:path';
import { fileURLToPath } from 'node:url';
import { gzipSync } from 'node:zlib';
import { launch, open } from './browser.mjs';
import { serve } from './server.mjs';

const PACKAGE = fileURLToPath(new URL('../../npm/', import.meta.url));
const KNIGHT = fileURLToPath(new URL('../../../../examples/knight.s4d', import.meta.url));
/// Second of the scene from which it counts as playing.
const PLAYS = 0.1;

const call = (program, args, cwd) => String(execFileSync(program, args, { cwd, stdio: ['ignore', 'pipe', 'ignore'] })).trim();
const now = () => performance.now() / 1000;

/// Waits until the page's scene plays; states how long it took since `begin`.
async function plays(browser, url, begin, what) {
  const { page, errors } = await open(browser, url, { viewport: { width: 400, height: 300 } });
  const started = () => document.querySelector('splat-4d')?.statistics?.firstFrame > 0;
  await page.waitForFunction(started, null, { timeout: 60000 });
  await page.evaluate(() => document.querySelector('splat-4d').play());
  await page.waitForFunction((t) => document.querySelector('splat-4d').currentTime > t, PLAYS, { timeout: 60000 });
  console.log(`${what}: ${(now() - begin).toFixed(1)} s${errors.length ? `, with errors: ${errors}` : ''}`);
  await page.close();
}

const work = mkdtempSync(path.join(tmpdir(), 'splat4d-figures-')),
  browser = await launch();
if (!browser) process.exit(1);
try {
  const tarball = path.join(work, call('npm', ['pack', '--silent', '--pack-destination', work], PACKAGE));
  console.log(`npm tarball: ${statSync(tarball).size} bytes`);
  let begin = now();
  call('npm', ['install', '--no-audit', '--no-fund', '--no-save', '--prefix', work, tarball], work);
  const installed = path.join(work, 'node_modules/splat4d');
  const page = `<!doctype html><script type="module" src="/splat4d/player/element.js"></script>
    <splat-4d src="/knight.s4d" style="display:block;width:400px;height:300px"></splat-4d>`;
  const folders = { '/splat4d/': installed };
  const server = await serve({ files: { 'page.html': page, 'knight.s4d': readFileSync(KNIGHT) }, folders });
  await plays(browser, `${server.url}page.html`, begin, 'empty folder, npm install of the tarball, the knight plays');
  await server.close();
  const modules = ['three.js', ...readdirSync(path.join(installed, 'player')).map((f) => `player/${f}`)];
  const zipped = modules.map((f) => gzipSync(readFileSync(path.join(installed, f))).length).reduce((a, b) => a + b);
  console.log(`${modules.length} modules, one by one as gzip: ${zipped} bytes`);

  const [wheel] = process.argv.slice(2);
  if (wheel) {
    console.log(`wheel: ${statSync(wheel).size} bytes`);
    begin = now();
    call('python3', ['-m', 'venv', path.join(work, 'python')]);
    call(path.join(work, 'python/bin/pip'), ['install', '-q', path.resolve(wheel)]);
    const view = spawn(path.join(work, 'python/bin/splat4d'), ['view', KNIGHT, '--no-open', '--json', '--port', '0'], {
      stdio: ['ignore', 'pipe', 'inherit'],
    });
    let said = '';
    for await (const data of view.stdout) if ((said += data).includes('"serving"')) break;
    const line = said.split('\n').find((l) => l.includes('"serving"'));
    await plays(browser, JSON.parse(line).url, begin, 'empty environment, pip install of the wheel, the knight plays');
    view.kill('SIGINT');
  }
} finally {
  await browser.close();
  rmSync(work, { recursive: true });
}

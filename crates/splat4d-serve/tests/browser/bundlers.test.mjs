// The package in the hands of TypeScript and of bundlers: Vite (its development server and its build), webpack and
// esbuild. Each page must play with both workers; a bundler that does not find them leaves all work to the main thread,
// without a message. Needs npm, and vite, webpack and esbuild next to playwright-core (`.ci/run`).

import assert from 'node:assert/strict';
import { execFileSync, spawnSync } from 'node:child_process';
import { cpSync, existsSync, mkdirSync, mkdtempSync, readdirSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { tmpdir } from 'node:os';
import path from 'node:path';
import test from 'node:test';
import { fileURLToPath, pathToFileURL } from 'node:url';
import { launch, open } from './browser.mjs';
import { serve } from './server.mjs';

const PACKAGE = fileURLToPath(new URL('../../npm/', import.meta.url));
const KNIGHT = readFileSync(fileURLToPath(new URL('../../../../examples/knight.s4d', import.meta.url)));
const from = createRequire(path.join(process.env.PLAYWRIGHT ?? '.', 'x.js'));
/// A bundler as a module, or null.
async function bundler(name) {
  try {
    return await import(pathToFileURL(from.resolve(name)));
  } catch (e) {
    if (process.env.REQUIRE_BUNDLERS === '1') throw e;
    return null;
  }
}
const [vite, webpack, esbuild] = await Promise.all(['vite', 'webpack', 'esbuild'].map(bundler));
const browser = vite && webpack && esbuild ? await launch() : null;
const options = { skip: browser ? false : 'needs vite, webpack, esbuild and a browser' };

const work = mkdtempSync(path.join(tmpdir(), 'splat4d-bundlers-'));
const html = (script) => `<!doctype html><link rel="icon" href="data:,"><body><splat-4d src="/knight.s4d" backend="webgl2"
  style="display:block;width:160px;height:120px;min-height:0"></splat-4d><script type="module" src="${script}"></script>`;
test.before(() => {
  if (!browser) return;
  const npm = (cwd, ...args) => String(execFileSync('npm', args, { cwd, stdio: ['ignore', 'pipe', 'ignore'] })).trim();
  const tarball = npm(PACKAGE, 'pack', '--silent', '--pack-destination', work);
  writeFileSync(path.join(work, 'package.json'), '{"private": true, "type": "module"}');
  npm(work, 'install', '--offline', '--no-audit', '--no-fund', '--no-save', path.join(work, tarball));
  writeFileSync(path.join(work, 'main.js'), "import 'splat4d';\n");
  writeFileSync(path.join(work, 'index.html'), html('/main.js'));
  mkdirSync(path.join(work, 'public'));
  writeFileSync(path.join(work, 'public/knight.s4d'), KNIGHT);
});
test.after(async () => {
  await browser?.close();
  rmSync(work, { recursive: true });
});

/// The page at `url` shows the scene with the workers of both kinds.
async function plays(url) {
  const { page, errors } = await open(browser, url);
  try {
    const shown = () => document.querySelector('splat-4d').statistics?.firstFrame > 0;
    await page.waitForFunction(shown, null, { timeout: 60000 });
    // One file sorts, another decodes; their names are the bundler's.
    const workers = new Set(page.workers().map((w) => w.url()));
    assert.deepEqual([workers.size, errors], [2, []], [...workers].join());
  } finally {
    await page.close();
  }
}

/// What a bundler wrote into a folder, on a server of its own.
async function built(folder, script) {
  const files = { 'knight.s4d': KNIGHT };
  if (script) files['index.html'] = html(script);
  const server = await serve({ files, folders: { '/': `${folder}/` } });
  try {
    await plays(`${server.url}index.html`);
  } finally {
    await server.close();
  }
}

test("Vite's development server", options, async () => {
  const server = await vite.createServer({ root: work, configFile: false, logLevel: 'error', server: { port: 0, host: '127.0.0.1' } });
  try {
    await server.listen();
    await plays(server.resolvedUrls.local[0]);
  } finally {
    await server.close();
  }
});

test("Vite's build", options, async () => {
  const out = path.join(work, 'vite');
  await vite.build({ root: work, configFile: false, logLevel: 'error', build: { outDir: out } });
  await built(out);
});

test('webpack', options, async () => {
  const out = path.join(work, 'webpack');
  const stats = await new Promise((done, failed) =>
    webpack.default({
      mode: 'production', context: work, entry: './main.js', output: { path: out, publicPath: 'auto' },
      performance: { hints: false }, optimization: { minimize: false },
    }, (error, stats) => (error ? failed(error) : done(stats))),
  );
  const { errors, warnings } = stats.toJson();
  assert.deepEqual([errors, warnings], [[], []]);
  await built(out, '/main.js');
});

test('esbuild, with the workers next to its output', options, async () => {
  const out = path.join(work, 'esbuild');
  const { warnings } = await esbuild.build({
    entryPoints: [path.join(work, 'main.js')], bundle: true, minify: true, format: 'esm', splitting: true, outdir: out, logLevel: 'silent',
  });
  assert.deepEqual(warnings, []);
  const player = path.join(work, 'node_modules/splat4d/player');
  for (const file of readdirSync(player).filter((f) => f.endsWith('.worker.js'))) cpSync(path.join(player, file), path.join(out, file));
  assert.ok(existsSync(path.join(out, 'sort.worker.js')));
  await built(out, '/main.js');
});

/// React's block of the package's README, and what its types refuse.
const TSX = () => /```tsx\n([\s\S]*?)```/.exec(readFileSync(path.join(PACKAGE, 'README.md'), 'utf8'))[1] + `
// @ts-expect-error: there is no such channel
export const wrong = <splat-4d channel="colour" />;
// @ts-expect-error: loop is text, because React leaves an attribute out that is false
export const once = <splat-4d loop={false} />;
`;

const tsc = (() => {
  try {
    return path.join(path.dirname(from.resolve('typescript/package.json')), 'bin/tsc');
  } catch (e) {
    if (process.env.REQUIRE_BUNDLERS === '1') throw e;
    return null;
  }
})();
test('the React example type-checks', { skip: browser && tsc ? false : 'needs typescript and @types/react' }, () => {
  const folder = path.join(work, 'typed');
  mkdirSync(folder);
  writeFileSync(path.join(folder, 'take.tsx'), TSX());
  const compilerOptions = {
    strict: true, noEmit: true, target: 'es2022', module: 'esnext', moduleResolution: 'bundler', jsx: 'react-jsx', types: [],
    paths: { react: [path.join(path.dirname(from.resolve('@types/react/package.json')), 'index.d.ts')],
      'react/jsx-runtime': [path.join(path.dirname(from.resolve('@types/react/package.json')), 'jsx-runtime.d.ts')] },
  };
  writeFileSync(path.join(folder, 'tsconfig.json'), JSON.stringify({ compilerOptions, include: ['take.tsx'] }));
  const { stdout, status } = spawnSync(process.execPath, [tsc, '-p', folder], { encoding: 'utf8' });
  assert.equal(status, 0, stdout);
});

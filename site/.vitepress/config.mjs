// The documentation site: the repository's Markdown files, the gallery and the API references. See ../CONTRIBUTING.md.
import { cpSync, existsSync, readdirSync, readFileSync } from 'node:fs';
import { dirname, join, resolve } from 'node:path';
import { fileURLToPath } from 'node:url';
import { defineConfig } from 'vitepress';
import { describe, equations, github, rows, slug } from './markdown.mjs';
import { crates, navigation, sidebar } from './navigation.mjs';

const root = resolve(dirname(fileURLToPath(import.meta.url)), '../..');
/** What `cargo doc --workspace --no-deps` wrote. */
const rustdoc = resolve(root, process.env.CARGO_TARGET_DIR ?? 'target', 'doc');
const api = crates.every(name => existsSync(join(rustdoc, name, 'index.html')));
if (!api && process.env.REQUIRE_API) {
  throw new Error(`${rustdoc} has no pages of ${crates.join(', ')}. Run: cargo doc --workspace --no-deps`);
}
/** Records, newest first: page and title. */
const records = readdirSync(join(root, 'studies/records')).filter(name => /^\d.*\.md$/.test(name)).sort().reverse()
  .map(name => [`studies/records/${name}`, readFileSync(join(root, 'studies/records', name), 'utf8').match(/^# (.*)/)[1]]);

/** Measurements and history come last. These functions run in the browser: they may use nothing from outside. */
const ranking = {
  options: {
    processTerm: term => ['a', 'an', 'and', 'for', 'in', 'is', 'of', 'on', 'the', 'to', 'with'].includes(term.toLowerCase()) ? null : term.toLowerCase(),
  },
  searchOptions: {
    boost: { title: 4, text: 2, titles: 2 },
    boostDocument: id => id.includes('/records/') || id.includes('CHANGELOG') ? 0.2 : 1,
  },
};

export default defineConfig({
  title: 'splat4d',
  description: 'Dynamic 3D scenes of Gaussians from multi-camera video: train, measure, compress, play.',
  lang: 'en-GB',
  base: process.env.SITE_BASE ?? '/',
  srcDir: root,
  srcExclude: ['{crates,examples,runs,site,target,xtask,studies/src}/**', '**/node_modules/**'],
  outDir: resolve(root, 'site/dist'),
  cacheDir: resolve(root, 'site/node_modules/.cache'),
  rewrites: { 'README.md': 'index.md', ':folder(.+)/README.md': ':folder/index.md' },
  head: [['link', { rel: 'icon', href: 'data:,' }]],
  // Pages are outside of the folder that has the modules.
  vite: { resolve: { alias: [{ find: /^vue(?=$|\/)/, replacement: join(root, 'site/node_modules/vue') }] } },
  vue: { template: { compilerOptions: { isCustomElement: tag => tag === 'splat-4d' } } },
  markdown: {
    math: true,
    anchor: { slugify: slug },
    config: md => void md.use(github, root).use(equations).use(rows),
  },
  transformPageData(page) {
    if (page.relativePath === 'index.md') Object.assign(page.frontmatter, home);
  },
  themeConfig: {
    nav: navigation(api),
    sidebar: sidebar(records, api, page => existsSync(join(root, page))),
    outline: [2, 3],
    search: { provider: 'local', options: { detailedView: true, _render: describe, miniSearch: ranking } },
    socialLinks: [{ icon: 'github', link: 'https://github.com/splat4d/splat4d' }],
    footer: { message: 'MIT or Apache-2.0' },
  },
  /** The player with its scenes, and the pages of rustdoc. */
  buildEnd({ outDir }) {
    cpSync(join(root, 'crates/splat4d-serve/player'), join(outDir, 'player'), { recursive: true });
    for (const name of readdirSync(join(root, 'examples')).filter(name => name.endsWith('.s4d'))) {
      cpSync(join(root, 'examples', name), join(outDir, 'scenes', name));
    }
    if (api) cpSync(rustdoc, join(outDir, 'api'), { recursive: true });
  },
});

/** The front page: this above the README. */
const home = {
  layout: 'home',
  hero: {
    name: 'splat4d',
    text: 'Dynamic 3D scenes from video',
    tagline: 'Train 4D Gaussians from multi-camera video on any CPU or GPU, and play them in any browser.',
    actions: [
      { theme: 'brand', text: 'First scene in five minutes', link: '/docs/first-scene' },
      { theme: 'alt', text: 'Gallery', link: '/docs/gallery' },
    ],
  },
  features: [
    { title: 'Tutorials', details: 'From the first scene to a motion model and a loss of your own.', link: '/docs/#tutorials' },
    { title: 'How-to guides', details: 'One task per page: film, compress, edit, train long captures, use a GPU.', link: '/docs/#how-to-guides' },
    { title: 'Reference', details: 'Command line, settings, Python, JavaScript, formats, metrics.', link: '/docs/#reference' },
    { title: 'Explanation', details: 'The methods with their equations, the architecture, determinism.', link: '/docs/#explanation' },
  ],
};

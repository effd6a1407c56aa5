// Run: node --test test.mjs
import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { existsSync, mkdtempSync, readdirSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join, resolve } from 'node:path';
import test from 'node:test';
import { fileURLToPath } from 'node:url';
import { describe, equations, github, rows, slug } from './.vitepress/markdown.mjs';
import { sidebar } from './.vitepress/navigation.mjs';

const root = resolve(dirname(fileURLToPath(import.meta.url)), '..');

/** What a plugin does with tokens on a page. */
function run(plugin, tokens, page) {
  plugin({ core: { ruler: { push: (name, rule) => rule({ tokens, env: { path: join(root, page), relativePath: page } }) } } }, root);
}
function token(type, attributes = {}, more = {}) {
  return { type, attrGet: name => attributes[name], attrSet: (name, value) => { attributes[name] = value; }, attributes, ...more };
}

test('anchors are those of GitHub', () => {
  assert.equal(slug('`capture.json`, version 1'), 'capturejson-version-1');
  assert.equal(slug('`C` & d'), 'c--d');
  assert.equal(slug('Größe'), 'größe');
});

test('links to pages stay, links to other files lead to the repository, and dead ones are errors', () => {
  const link = (href, page = 'docs/models.md') => {
    const open = token('link_open', { href });
    run(github, [token('inline', {}, { children: [open] })], page);
    return open.attributes.href;
  };
  assert.equal(link('gpu.md#speed'), 'gpu.md#speed');
  assert.equal(link('../README.md'), '../index.md');
  assert.equal(link('docs/README.md', 'README.md'), 'docs/index.md');
  assert.equal(link('https://example.org/a.md'), 'https://example.org/a.md');
  assert.equal(link('#here'), '#here');
  assert.equal(link('../Cargo.toml'), 'https://github.com/splat4d/splat4d/blob/main/Cargo.toml');
  assert.equal(link('../examples/knight'), 'https://github.com/splat4d/splat4d/tree/main/examples/knight');
  assert.throws(() => link('../nothing.rs'), /leads nowhere/);
});

test('fenced equations become blocks of mathematics, and other fences stay', () => {
  const fences = ['math', 'js'].map(info => ({ type: 'fence', info }));
  run(equations, fences, 'docs/models.md');
  assert.deepEqual(fences.map(f => f.type), ['math_block', 'fence']);
});

test('settings, options and members are found by their names', () => {
  const anchor = (page, heading, cell) => {
    const row = token('tr_open');
    const code = { children: [{ type: 'code_inline', content: cell }] };
    run(rows, [token('heading_open'), { type: 'inline', content: heading }, row, token('td_open'), code], page);
    return row.attributes.id;
  };
  assert.equal(anchor('docs/recipe-density.md', '`[densify]`', 'max_cap'), 'densify.max_cap');
  assert.equal(anchor('docs/recipe.md', 'Choose quality', 'draft'), undefined);
  assert.equal(anchor('docs/cli.md', 'train', '-o, --output RUN'), 'train--output');
  assert.equal(anchor('docs/cli.md', 'train', 'CAPTURE'), undefined);
  assert.equal(anchor('docs/python-api.md', 'Scene', 'at(t: float) -> Gaussians'), 'Scene.at');
  assert.equal(anchor('docs/gpu.md', '`[densify]`', 'max_cap'), undefined);
  const page = describe('', {}, { render: () => '<table><tr id="train--output"><td>x</td></tr></table>' });
  assert.match(page, /<h3>train --output <a href="#train--output">#<\/a><\/h3><tr/);
});

test('every page of docs/ is in the navigation, and nothing else', () => {
  const links = items => items.flatMap(item => [item.link, ...links(item.items ?? [])]).filter(Boolean);
  const listed = new Set(links(sidebar([], false, page => existsSync(join(root, page)))).filter(l => l.startsWith('/docs/')));
  const there = readdirSync(join(root, 'docs')).filter(name => name.endsWith('.md')).map(name => `/docs/${name.slice(0, -3)}`);
  // The top of every page links to these.
  const elsewhere = ['/docs/README', '/docs/gallery'];
  assert.deepEqual([...listed].sort(), there.filter(page => !elsewhere.includes(page)).sort());
});

test('dead links of a built site are found', () => {
  const folder = mkdtempSync(join(tmpdir(), 'site-'));
  const check = page => {
    writeFileSync(join(folder, 'a.html'), page);
    const { status, stderr } = spawnSync(process.execPath, [join(root, 'site/check.mjs'), folder], { encoding: 'utf8' });
    return [status, stderr];
  };
  try {
    writeFileSync(join(folder, 'index.html'), '<h2 id="x">x</h2>');
    assert.deepEqual(check('<a href="/#x"></a><a href="index.html"></a><a href="https://example.org/no"></a>'), [0, '']);
    for (const dead of ['/b', '/#y', 'b.html', '#z']) {
      const [status, text] = check(`<a href="${dead}"></a>`);
      assert.equal(status, 1, dead);
      assert.match(text, new RegExp(`a.html: ${dead}`));
    }
    assert.equal(check('<img src="no.png">')[0], 1);
  } finally {
    rmSync(folder, { recursive: true });
  }
});

// How the repository's Markdown becomes pages that also read well on GitHub.
import { existsSync, statSync } from 'node:fs';
import { join, posix } from 'node:path';

const REPOSITORY = 'https://github.com/splat4d/splat4d/blob/main/';
/** Folders whose Markdown files are pages; with it those of the root. */
const PAGES = /^(docs\/[^/]+|studies\/records\/[^/]+|[^/]+)\.md$/;

const isPage = path => PAGES.test(path);

/** A heading's anchor, as GitHub makes it. */
export function slug(heading) {
  return heading.trim().toLowerCase().replace(/[^\p{L}\p{N} _-]/gu, '').replaceAll(' ', '-');
}

/** A plugin: relative links to pages lead to pages, those to other files of the repository to GitHub. */
export function github(md, root) {
  md.core.ruler.push('github', ({ tokens, env }) => {
    const folder = posix.dirname((env.realPath ?? env.path).slice(root.length + 1));
    for (const token of tokens.flatMap(t => t.children ?? [])) {
      const href = token.type === 'link_open' ? token.attrGet('href') : null;
      if (!href || /^([a-z]+:|#)/i.test(href)) continue;
      const [path, anchor] = href.split('#');
      const full = posix.normalize(posix.join(folder, decodeURI(path)));
      const place = anchor ? `#${anchor}` : '';
      if (isPage(full)) {
        token.attrSet('href', `${path.replace(/README\.md$/, 'index.md')}${place}`);
      } else if (!existsSync(join(root, full))) {
        throw new Error(`${env.path}: the link ${href} leads nowhere`);
      } else {
        const kind = statSync(join(root, full)).isDirectory() ? REPOSITORY.replace('/blob/', '/tree/') : REPOSITORY;
        token.attrSet('href', kind + full + place);
      }
    }
  });
}

/** A plugin: fenced blocks `math` are equations, as on GitHub. */
export function equations(md) {
  md.core.ruler.push('equations', ({ tokens }) => {
    for (const token of tokens) if (token.type === 'fence' && token.info.trim() === 'math') token.type = 'math_block';
  });
}

/** Pages whose table rows are entries of a reference, and an entry's name by its section and first cell; none: no entry. */
const REFERENCES = [
  // `densify.max_cap` of `max_cap` under `[densify]`.
  [/(^|\/)recipe[a-z-]*\.md$/, (section, cell) => section.match(/^`\[(\w+)\]`$/)?.[1].concat('.', cell)],
  // `train --minutes` of `--minutes M` under `train`.
  [/(^|\/)cli[a-z-]*\.md$/, (section, cell) => cell.match(/--[\w-]+/)?.[0].replace(/^/, `${section} `)],
  // `Scene.at` of `at(t: float) -> Gaussians` under `Scene`.
  [/(^|\/)python-api(-scenes)?\.md$/, (section, cell) => cell.match(/^\w+/)?.[0].replace(/^/, `${section}.`)],
];

/** A plugin: every setting, option and member is a row with an anchor of its own. */
export function rows(md) {
  md.core.ruler.push('rows', ({ tokens, env }) => {
    const name = REFERENCES.find(([page]) => page.test(env.relativePath ?? ''))?.[1];
    if (!name) return;
    let section = '';
    tokens.forEach((token, i) => {
      if (token.type === 'heading_open') section = tokens[i + 1].content;
      const first = token.type === 'tr_open' ? tokens[i + 2].children?.[0] : null;
      const entry = first?.type === 'code_inline' ? name(section, first.content) : null;
      if (entry) token.attrSet('id', entry.replace(' ', ''));
    });
  });
}

/** What the search indexes of a page: each row with an anchor is a section of its own. */
export function describe(source, env, md) {
  const html = md.render(source, env);
  return html.replace(/<tr id="([^"]*)"/g, (row, id) => `<h3>${id.replace('--', ' --')} <a href="#${id}">#</a></h3>${row}`);
}

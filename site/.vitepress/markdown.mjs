// How the repository's Markdown becomes pages that also read well on GitHub.
import { existsSync, statSync } from 'node:fs';
import { join, posix } from 'node:path';

const REPOSITORY = 'https://github.com/splat4d/splat4d/blob/main/';
/** Folders whose Markdown files are pages; with it those of the root. */
const PAGES = /^(docs\/[^/]+|studies\/records\/[^/]+|[^/]+)\.md$/;

export const isPage = path => PAGES.test(path);

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

/** Pages whose table rows are entries of a reference: settings and options. */
const REFERENCE = /(^|\/)(recipe|cli)[a-z-]*\.md$/;

/** An entry's name: `densify.max_cap` of row `max_cap` under `[densify]`, `train --minutes` of `--minutes` under `train`. */
function entry(heading, cell) {
  const name = cell.split(' ').find(word => word.startsWith('--')) ?? cell.split(' ')[0];
  const table = heading.replace(/[`[\]]/g, '');
  return name.startsWith('-') ? `${table} ${name}` : `${table}.${name}`;
}

/** A plugin: every setting and option is a row with an anchor of its own. */
export function rows(md) {
  md.core.ruler.push('rows', ({ tokens, env }) => {
    if (!REFERENCE.test(env.relativePath ?? '')) return;
    let heading = '';
    tokens.forEach((token, i) => {
      if (token.type === 'heading_open') heading = tokens[i + 1].content;
      const first = token.type === 'tr_open' ? tokens[i + 2].children?.[0] : null;
      if (first?.type === 'code_inline') token.attrSet('id', entry(heading, first.content).replaceAll(' ', '-'));
    });
  });
}

/** What the search indexes of a page: each row with an anchor is a section of its own. */
export function describe(source, env, md) {
  const html = md.render(source, env);
  return html.replace(/<tr id="([^"]*)"/g, (row, id) => `<h4>${id} <a href="#${id}">#</a></h4>${row}`);
}

// Fails if a link of a built site leads to no page, file or anchor: `node check.mjs [FOLDER]`. Links to other sites are not
// followed; pages of rustdoc are checked by rustdoc itself.
import { existsSync, readFileSync, readdirSync } from 'node:fs';
import { dirname, join, posix } from 'node:path';
import { fileURLToPath } from 'node:url';

const folder = process.argv[2] ?? join(dirname(fileURLToPath(import.meta.url)), 'dist');
const base = process.env.SITE_BASE ?? '/';
const pages = readdirSync(folder, { recursive: true }).filter(name => name.endsWith('.html') && !/^(api|player)\//.test(name));
const html = new Map(pages.map(name => [name, readFileSync(join(folder, name), 'utf8')]));
const anchors = new Map([...html].map(([name, text]) => [name, new Set([...text.matchAll(/ id="([^"]*)"/g)].map(id => id[1]))]));

const broken = new Set();
let links = 0;
for (const [page, text] of html) {
  for (const [, target] of text.matchAll(/ (?:href|src)="([^"]*)"/g)) {
    if (/^([a-z]+:|\/\/)/i.test(target)) continue;
    links += 1;
    const [path, anchor] = target.replaceAll('&amp;', '&').split('#');
    const file = path.startsWith(base) ? path.slice(base.length) : posix.join(posix.dirname(page), path);
    const found = [path ? file : page, `${file}.html`, posix.join(file, 'index.html')]
      .find(name => /\.\w+$/.test(name) && existsSync(join(folder, name)));
    const missing = anchor && anchors.has(found) && !anchors.get(found).has(decodeURIComponent(anchor));
    if (!found || missing) broken.add(`${page}: ${target}`);
  }
}
if (broken.size) {
  console.error(`broken links:\n${[...broken].join('\n')}`);
  process.exit(1);
}
console.log(`${pages.length} pages, ${links} links, none broken`);

// Fails if a link of the built site leads to no page, file or anchor. Links to other sites are not followed; pages of rustdoc
// are checked by rustdoc itself.
import { existsSync, readFileSync, readdirSync } from 'node:fs';
import { dirname, join, posix } from 'node:path';
import { fileURLToPath } from 'node:url';

const dist = join(dirname(fileURLToPath(import.meta.url)), 'dist');
const base = process.env.SITE_BASE ?? '/';
const pages = readdirSync(dist, { recursive: true }).filter(name => name.endsWith('.html') && !/^(api|player)\//.test(name));
const html = new Map(pages.map(name => [name, readFileSync(join(dist, name), 'utf8')]));
const ids = text => new Set([...text.matchAll(/ id="([^"]*)"/g)].map(match => match[1]));
const anchors = new Map([...html].map(([name, text]) => [name, ids(text)]));

const broken = [];
let links = 0;
for (const [page, text] of html) {
  for (const [, target] of text.matchAll(/ (?:href|src)="([^"]*)"/g)) {
    if (/^([a-z]+:|\/\/)/i.test(target)) continue;
    links += 1;
    const [path, anchor] = target.replaceAll('&amp;', '&').split('#');
    const file = path.startsWith(base) ? path.slice(base.length) : posix.join(posix.dirname(page), path);
    const found = [path ? file : page, `${file}.html`, posix.join(file, 'index.html')]
      .find(name => existsSync(join(dist, name)) && /\.\w+$/.test(name));
    if (!found || (anchor && anchors.has(found) && !anchors.get(found).has(decodeURIComponent(anchor)))) {
      broken.push(`${page}: ${target}`);
    }
  }
}
if (broken.length) {
  console.error(`broken links:\n${[...new Set(broken)].join('\n')}`);
  process.exit(1);
}
console.log(`${pages.length} pages, ${links} links, none broken`);

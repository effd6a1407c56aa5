// Puts the player's modules into the package. They are the sources themselves: nothing is built, only lines that are
// comments and nothing else are left empty, as the program's own server does (src/assets.rs).

import { cpSync, mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from 'node:fs';

const from = new URL('../player/', import.meta.url),
  to = new URL('./player/', import.meta.url);
/// Of the program's own page: an embedding page has its own.
const OWN = ['index.html', 'measure.js', 'page.js'];

function lean(text) {
  let inside = false;
  const lines = text.split('\n').map((line) => {
    const bare = line.trim(),
      starts = bare.startsWith('/**'),
      comment = inside || starts || bare.startsWith('//');
    if (inside || starts) inside = !bare.endsWith('*/');
    return comment ? '' : line;
  });
  return lines.join('\n');
}

rmSync(to, { recursive: true, force: true });
for (const name of readdirSync(from)) {
  // The shaders' own files are in shaders.js already.
  if (OWN.includes(name) || ['edit', 'assist'].some((own) => name.startsWith(own)) || !name.endsWith('.js')) continue;
  mkdirSync(to, { recursive: true });
  writeFileSync(new URL(name, to), lean(readFileSync(new URL(name, from), 'utf8')));
}
for (const name of ['LICENSE-MIT', 'LICENSE-APACHE']) {
  cpSync(new URL(`../../../${name}`, import.meta.url), new URL(`./${name}`, import.meta.url));
}
// One version for everything: that of the workspace.
const cargo = readFileSync(new URL('../../../Cargo.toml', import.meta.url), 'utf8');
const [, version] = /\[workspace\.package\]\s*version = "([^"]+)"/.exec(cargo);
const file = new URL('./package.json', import.meta.url),
  text = readFileSync(file, 'utf8');
const stamped = text.replace(/"version": "[^"]+"/, `"version": "${version}"`);
if (stamped !== text) writeFileSync(file, stamped);

// Starts a Chromium for tests: Debian's, through playwright-core, which `.ci/run` installs (PLAYWRIGHT names its folder
// where it does not lie next to the tests).

import { existsSync } from 'node:fs';
import { createRequire } from 'node:module';
import path from 'node:path';

/// Where Chromium is: CHROMIUM, or where Debian puts it.
const PROGRAM = process.env.CHROMIUM ?? '/usr/bin/chromium';
/// WebGPU and WebGL2 through SwiftShader, and nothing that phones home.
const FLAGS = [
  '--no-sandbox',
  '--disable-background-networking',
  '--disable-component-update',
  '--disable-sync',
  '--no-first-run',
  '--enable-unsafe-webgpu',
  '--use-webgpu-adapter=swiftshader',
  // Without these three a WebGPU canvas takes the GPU process down where there is no graphics card.
  '--enable-features=Vulkan',
  '--use-vulkan=swiftshader',
  '--use-angle=swiftshader',
];

/// A browser, or null where there is none; with REQUIRE_BROWSER=1 that is an error.
export async function launch() {
  try {
    if (!existsSync(PROGRAM)) throw new Error(`${PROGRAM} does not exist`);
    const beside = process.env.PLAYWRIGHT ? path.join(process.env.PLAYWRIGHT, 'x.js') : import.meta.url;
    const { chromium } = createRequire(beside)('playwright-core');
    return await chromium.launch({ executablePath: PROGRAM, args: FLAGS });
  } catch (e) {
    if (process.env.REQUIRE_BROWSER === '1') throw e;
    console.log(`skipped: no browser (${e.message})`);
    return null;
  }
}

/// A page at `url` that records what goes wrong: {page, errors}.
export async function open(browser, url, options = {}) {
  const page = await browser.newPage(options),
    errors = [];
  page.on('console', (m) => m.type() === 'error' && errors.push(m.text()));
  page.on('pageerror', (e) => errors.push(e.stack ?? e.message));
  await page.goto(url);
  return { page, errors };
}

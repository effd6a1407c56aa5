// The built site in Chromium: the scenes play, the search leads to settings, phones scroll in one direction.
// Run after `npm run build`: PLAYWRIGHT=FOLDER node --test browser.test.mjs (FOLDER has playwright-core in node_modules).
import assert from 'node:assert/strict';
import { after, before, test } from 'node:test';
import { fileURLToPath } from 'node:url';
import { launch, open } from '../crates/splat4d-serve/tests/browser/browser.mjs';
import { serve } from '../crates/splat4d-serve/tests/browser/server.mjs';

/** A busy machine without a GPU renders a frame in seconds. */
const PATIENCE = { timeout: 120_000 };
const PHONE = { width: 390, height: 844 };

const browser = await launch();
const skip = !browser && 'no browser';
let site;
before(async () => { site = await serve({ folders: { '/': fileURLToPath(new URL('dist/', import.meta.url)) } }); });
after(async () => { await browser?.close(); site.close(); });

/** Errors of a page, except for missing WebGPU. */
const serious = errors => errors.filter(text => !/WebGPU|adapter/i.test(text));

for (const [name, size] of [['docs/gallery.html', { width: 1400, height: 900 }], ['index.html', PHONE]]) {
  test(`${name} plays the bundled scene`, { skip }, async () => {
    const { page, errors } = await open(browser, `${site.url}${name}`, { viewport: size });
    await page.waitForFunction(() => document.querySelector('splat-4d')?.statistics?.drawn > 0, null, PATIENCE);
    const first = await page.evaluate(() => document.querySelector('splat-4d').currentTime);
    await page.waitForFunction(time => document.querySelector('splat-4d').currentTime !== time, first, PATIENCE);
    assert.deepEqual(serious(errors), []);
    await page.close();
  });
}

test('the search finds a setting and links to its row', { skip }, async () => {
  const { page, errors } = await open(browser, `${site.url}docs/recipe.html`, { viewport: { width: 1400, height: 900 } });
  await page.locator('.VPNavBarSearch button').first().click(PATIENCE);
  await page.fill('.search-input', 'max_cap', PATIENCE);
  await page.locator('.result', { hasText: 'densify.max_cap' }).first().click(PATIENCE);
  await page.waitForURL('**/docs/recipe-density.html#densify.max_cap', PATIENCE);
  await page.locator('tr[id="densify.max_cap"]').waitFor(PATIENCE);
  assert.deepEqual(serious(errors), []);
  await page.close();
});

test('on a phone, pages scroll in one direction only', { skip }, async () => {
  for (const name of ['index', 'docs/index', 'docs/recipe', 'docs/cli', 'docs/format', 'docs/method-rendering', 'docs/python-api']) {
    const { page } = await open(browser, `${site.url}${name}.html`, { viewport: PHONE });
    const beyond = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    assert.equal(beyond, 0, `${name} is ${beyond} pixels too wide`);
    await page.close();
  }
});

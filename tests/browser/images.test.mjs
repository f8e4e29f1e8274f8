// Images of other programs, opened by the page itself: there is no Saccade server, only servers of files.
import assert from 'node:assert/strict';
import { join } from 'node:path';
import { after, before, beforeEach, test } from 'node:test';

import { launch, open } from './lib/browser.mjs';
import { serveFiles, WINDOW, writePrecomputed, writeZarr } from './lib/images.mjs';
import { covered, picture, psnr } from './lib/picture.mjs';
import { folder, run, until } from './lib/saccade.mjs';

const BUNDLE = process.env.SACCADE_WEB_DIR;
if (!BUNDLE) throw new Error('SACCADE_WEB_DIR must name the folder of the browser application; ./dev test sets it');

const SIZE = { width: 200, height: 150 };
const CAMERA = '30,25,1500,465,350,510';
const OTHER_CAMERA = '60,25,1500,465,350,510';
const TRANSFER = JSON.stringify({
  polarity: 'bright',
  color_map: 'viridis',
  window: [0.1, 0.9],
  opacity: [{ value: 0.2, opacity: 0 }, { value: 0.5, opacity: 0.6 }],
  opacity_length_nm: 40,
});
/** Two software drivers agree to 62 dB; a camera 30 degrees off to 22 dB. */
const AGREE_DB = 45;

let work, browser, pages, images, rendered;

before(async () => {
  work = await folder();
  await writeZarr(join(work.path, 'em.zarr'));
  await writePrecomputed(join(work.path, 'em.precomputed'));
  // Zarr version 3, in shards, by zstd: what browsers decode by other code than native programs.
  await run('export', join(work.path, 'em.zarr'), join(work.path, 'sharded.zarr'));
  [pages, images] = [await serveFiles(BUNDLE), await serveFiles(work.path)];
  browser = await launch();
  rendered = await render(CAMERA);
  const control = psnr(rendered, await render(OTHER_CAMERA));
  assert.ok(control < AGREE_DB - 15, `another camera's picture agrees as well: ${control} dB`);
});

after(async () => {
  await browser?.close();
  await Promise.all([pages, images].map((server) => server?.stop()));
  await work?.release();
});

beforeEach(() => {
  Object.assign(images.rules, { cors: true, ranges: true, preflight: false, delay: 0, damage: (_, bytes) => bytes });
  images.log.length = 0;
});

for (const name of ['em.zarr', 'sharded.zarr', 'em.precomputed']) {
  test(`${name} is shown as saccade render shows it`, async () => {
    const { page, complaints } = await show(name);
    await settled(page);
    const shown = picture(await page.screenshot());
    const agreement = psnr(await shown, rendered);
    assert.ok(covered(await shown) > 0.1, 'nothing is seen');
    assert.ok(agreement >= AGREE_DB, `the pictures agree to ${agreement} dB only`);
    // A browser complains of every object that there is not.
    assert.deepEqual(complaints.filter((text) => !/404/.test(text)), []);
    const decoders = await counts(page);
    assert.ok(decoders.workers >= 1 && decoders.by_workers > 2, JSON.stringify(decoders));
    assert.equal(decoders.by_the_page, 0, 'the page itself decoded');
    assert.equal(page.workers().length, decoders.workers);
    console.log(`${name}: agreement ${agreement.toFixed(1)} dB, ${images.log.length} requests, ${JSON.stringify(decoders)}`);
    await page.context().close();
  });
}

test('an image is shown in the colours and the window that it asks for', async () => {
  const { page } = await open(browser, SIZE);
  const url = new URL(address('em.zarr'));
  url.searchParams.delete('transfer');
  await page.goto(url.href);
  await settled(page);
  const { transfer } = await status(page);
  assert.equal(transfer.color_map, 'magenta');
  assert.deepEqual(transfer.window.map((share) => Math.round(255 * share)), WINDOW);
  const shown = await picture(await page.screenshot());
  const sums = [0, 1, 2].map((c) => shown.data.reduce((sum, value, i) => (i % 4 === c ? sum + value : sum), 0));
  assert.ok(sums[0] > 1e5 && Math.abs(sums[0] - sums[2]) < 0.02 * sums[0] && sums[1] < 0.02 * sums[0], `${sums}`);
  const agreement = psnr(shown, await render(CAMERA, JSON.stringify(transfer)));
  assert.ok(agreement >= AGREE_DB, `the pictures agree to ${agreement} dB only`);
  await page.context().close();
});

test('all that an address asks for is shown, and what is outside of the volume is told', async () => {
  const { page } = await open(browser, SIZE);
  const asked = [['slice', 'z=25'], ['slab', '400'], ['cut', 'x=20'], ['cut', '0,-1,0@0,60,0'], ['detail', '1']];
  const url = new URL(address('em.zarr'));
  for (const [name, value] of asked) url.searchParams.append(name, value);
  await page.goto(url.href);
  await settled(page);
  const want = await render(CAMERA, TRANSFER, ...asked.flatMap(([name, value]) => [`--${name}`, value]));
  const shown = await picture(await page.screenshot());
  const agreement = psnr(shown, want);
  assert.ok(agreement >= AGREE_DB, `the pictures agree to ${agreement} dB only`);
  for (const left of ['slab', 'cut', 'detail']) {
    const others = asked.filter(([name]) => name !== left);
    const control = psnr(shown, await render(CAMERA, TRANSFER, ...others.flatMap(([name, value]) => [`--${name}`, value])));
    assert.ok(control < AGREE_DB - 5, `without ${left} the picture is the same: ${control} dB`);
  }
  url.searchParams.set('slice', 'z=9999');
  await page.goto(url.href);
  assert.match(await message(page), /z=9999 is outside the volume, in which z goes from 0 to 50/);
  await page.context().close();
});

test('a server that knows no ranges is slow, not wrong', async () => {
  images.rules.ranges = false;
  const { page } = await show('sharded.zarr');
  await settled(page);
  const agreement = psnr(await picture(await page.screenshot()), rendered);
  assert.ok(agreement >= AGREE_DB, `the pictures agree to ${agreement} dB only`);
  assert.ok(images.log.some(({ range }) => range), 'no range was asked for');
  await page.context().close();
});

test('requests that nobody waits for any more are given up', async () => {
  images.rules.delay = 3000;
  const { page } = await show('em.precomputed');
  await until('the image is open', async () => (await status(page))?.requests > 0, 60);
  const begun = images.log.length;
  await page.goto('about:blank');
  await until('they end', async () => images.log.every(({ ended, closed }) => ended || closed), 10);
  assert.ok(images.log.slice(0, begun).some(({ ended }) => !ended), 'all were answered');
  await page.context().close();
});

test('a server that does not let pages read is told from one that is not there', async () => {
  images.rules.cors = false;
  const { page } = await show('em.zarr');
  const words = await message(page);
  assert.match(words, /Access-Control-Allow-Origin: \*.*\(?CORS|CORS.*Access-Control-Allow-Origin: \*/);
  assert.ok(words.includes(`${images.url}/em.zarr/zarr.json`), words);
  // The form opens another, or the same once the server is mended.
  images.rules.cors = true;
  assert.equal(await page.locator('#source').inputValue(), `${images.url}/em.zarr`);
  await page.locator('#source').fill(`${images.url}/em.precomputed`);
  await page.getByRole('button', { name: 'Open' }).click();
  await until('the other image is open', async () => (await status(page))?.volume === 'em.precomputed', 60);

  const nobody = await serveFiles(work.path);
  await nobody.stop();
  await page.goto(`${pages.url}/?source=${encodeURIComponent(`${nobody.url}/em.zarr`)}`);
  const gone = await message(page);
  assert.match(gone, /can this computer reach the server/);
  assert.doesNotMatch(gone, /CORS/);
  await page.goto(`${pages.url}/?source=${encodeURIComponent(`${images.url}/nothing`)}`);
  assert.match(await message(page), /no image that can be opened/);
  await page.context().close();
});

test('a damaged chunk is named, and the others are shown', async () => {
  images.rules.damage = (path, bytes) => (path.endsWith('/em.zarr/0/0/0/0') ? bytes.subarray(0, bytes.length / 2) : bytes);
  const { page } = await show('em.zarr');
  await settled(page, 'failed');
  const { failure, missing } = await status(page);
  assert.match(failure, /chunk \[0, 0, 0\] of level 0 is damaged/);
  assert.ok(failure.includes(`${images.url}/em.zarr/0/0/0/0`), failure);
  assert.ok(missing > 0);
  const difference = psnr(await picture(await page.screenshot()), rendered);
  assert.ok(difference < AGREE_DB && difference > 15, `${difference} dB`);
  await page.context().close();
});

test('workers that break down are replaced, and nothing is lost', async () => {
  images.rules.delay = 400;
  const { page } = await show('em.zarr');
  await until('workers are there', async () => page.workers().length > 0, 60);
  const break_one = (worker) => worker.evaluate(() => { setTimeout(() => { throw new Error('broken on purpose'); }); });
  for (const worker of page.workers()) await break_one(worker).catch(() => {});
  await until('they are replaced', async () => (await counts(page)).replaced > 0, 30);
  await settled(page);
  const agreement = psnr(await picture(await page.screenshot()), rendered);
  assert.ok(agreement >= AGREE_DB, `the pictures agree to ${agreement} dB only`);
  const decoders = await counts(page);
  assert.ok(decoders.by_workers > 5 && decoders.by_the_page === 0, JSON.stringify(decoders));
  await page.context().close();
});

test('without workers the page decodes by itself', async () => {
  const { page } = await open(browser, SIZE);
  await page.route('**/decoder.js', (route) => route.fulfill({ status: 404, body: '' }));
  await page.goto(address('em.zarr'));
  await settled(page);
  const agreement = psnr(await picture(await page.screenshot()), rendered);
  assert.ok(agreement >= AGREE_DB, `the pictures agree to ${agreement} dB only`);
  const { workers, by_workers: byWorkers, by_the_page: byThePage } = await counts(page);
  assert.deepEqual([workers, byWorkers], [0, 0]);
  assert.ok(byThePage > 5, 'nobody decoded');
  await page.context().close();
});

const counts = (page) => page.evaluate(() => window.saccade.decoders());

/** Waits for the page to say why it shows nothing. */
async function message(page) {
  await until('there is a message', async () => (await page.evaluate(() => window.saccade?.error)) != null, 60);
  await page.locator('#message').waitFor({ state: 'visible' });
  return page.locator('#words').innerText();
}

/** Opens the page on an image. */
async function show(name) {
  const opened = await open(browser, SIZE);
  await opened.page.goto(address(name));
  return opened;
}

function address(name) {
  const url = new URL(pages.url);
  url.search = new URLSearchParams({ ui: 'off', camera: CAMERA, transfer: TRANSFER, source: `${images.url}/${name}` });
  return url.href;
}

const status = (page) => page.evaluate(() => JSON.parse(JSON.stringify(window.saccade?.status?.() ?? null)));

async function settled(page, fidelity = 'complete') {
  await until(`the picture is ${fidelity}`, async () => {
    const [shown, error] = [await status(page), await page.evaluate(() => window.saccade?.error)];
    if (error) throw new Error(error);
    return shown?.fidelity === fidelity || shown;
  }, 120);
}

async function render(camera, transfer = TRANSFER, ...more) {
  const out = join(work.path, 'render.png');
  await run('render', join(work.path, 'em.zarr'), '--camera', camera, '--transfer', transfer,
    '--size', `${SIZE.width}x${SIZE.height}`, ...more, '-o', out);
  return picture(out);
}

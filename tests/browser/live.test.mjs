// The application against a live simulated stream.
import assert from 'node:assert/strict';
import { access, appendFile, readFile, writeFile } from 'node:fs/promises';
import { join } from 'node:path';
import { after, before, test } from 'node:test';

import { launch, open, rememberDevices, reportShaders } from './lib/browser.mjs';
import { covered, grayPng, picture, psnr } from './lib/picture.mjs';
import { folder, run, start, until } from './lib/saccade.mjs';

const SIZE = { width: 200, height: 150 };
const CAMERA = '30,25,5300,1024,1024,640';
const OTHER_CAMERA = '38,25,5300,1024,1024,640';
// Structures are dark; a window in which they and what surrounds them differ.
const TRANSFER = JSON.stringify({
  polarity: 'dark',
  color_map: 'gray',
  window: [0.1, 0.8],
  opacity: [{ value: 0.15, opacity: 0.9 }, { value: 0.7, opacity: 0.02 }],
  opacity_length_nm: 40,
});
/** Two software drivers agree to 62 dB; a camera 8 degrees off to 23 dB. */
const AGREE_DB = 45;

let work, browser, processes, url, page, complaints;

before(async () => {
  work = await folder();
  processes = [];
  const acquisition = join(work.path, 'acquisition');
  const archive = join(work.path, 'archive');
  processes.push(start('simulate', acquisition, '--phantom', '--extent', '256,256,32', '--voxel-nm', '8,8,40',
    '--tile', '160x160', '--rate', '0.5', '--corrections', 'never', '--seed', '7'));
  await exists(join(acquisition, 'volume.json'));
  processes.push(start('ingest', acquisition, archive));
  await exists(join(archive, 'catalog.sqlite'));
  const serve = start('serve', archive, '--port', '0');
  processes.push(serve);
  [url] = await serve.printed(/http:\/\/[\w.:]+/);
  await until('tiles arrive', async () => (await served())[0]?.revision > 8, 60);
  // The microscope pauses, so that the page opens on part of the volume however slow the machine.
  processes[0].child.kill('SIGSTOP');
  browser = await launch();
  ({ page, complaints } = await open(browser, SIZE));
  await reportShaders(page);
  await rememberDevices(page);
});

after(async () => {
  await browser?.close();
  await Promise.all((processes ?? []).map((p) => p.stop()));
  await work?.release();
});

test('the live volume reaches completeness, and agrees with saccade render', async () => {
  const address = new URL(url);
  address.search = new URLSearchParams({ ui: 'off', camera: CAMERA, transfer: TRANSFER });
  await page.goto(address.href);
  await page.evaluate(() => { window.notReloaded = true; });
  await settled();
  const part = await shot();
  processes[0].child.kill('SIGCONT');
  await processes[0].success();
  await settled();

  const shown = await shot();
  const growth = psnr(part, shown);
  assert.ok(growth < AGREE_DB - 15, `the volume did not grow: ${growth} dB`);
  assert.ok(covered(shown) > 0.2, `the volume covers ${covered(shown)} of the picture`);
  const agreement = psnr(shown, await rendered(CAMERA));
  assert.ok(agreement >= AGREE_DB, `the pictures agree to ${agreement} dB only`);
  const control = psnr(shown, await rendered(OTHER_CAMERA));
  assert.ok(control < AGREE_DB - 15, `another camera's picture agrees as well: ${control} dB`);
  console.log(`grown by ${growth.toFixed(1)} dB, agreement ${agreement.toFixed(1)} dB, another camera ${control.toFixed(1)} dB`);
});

test('a tile ingested afterwards changes the picture without a reload', async () => {
  const before = await shot();
  const acquisition = join(work.path, 'acquisition');
  await writeFile(join(acquisition, 'tiles', 'late.png'), grayPng(256, 256, (x, y) => ((x >> 6) + (y >> 6)) % 2 ? 20 : 235));
  const record = { record: 'tile', tile: 'late', file: 'tiles/late.png', section: 0, size: [256, 256], transform: [1, 0, 0, 1, 0, 0] };
  await appendFile(join(acquisition, 'tiles.jsonl'), JSON.stringify(record) + '\n');
  await settled();

  const shown = await shot();
  const change = psnr(before, shown);
  assert.ok(change < AGREE_DB - 15, `the picture did not change: ${change} dB`);
  const agreement = psnr(shown, await rendered(CAMERA));
  assert.ok(agreement >= AGREE_DB, `the pictures agree to ${agreement} dB only`);
  assert.equal(await page.evaluate(() => window.notReloaded), true);
});

test('a lost device is replaced, and the picture returns', async () => {
  const before = await shot();
  const devices = await page.evaluate(() => window.devices.length);
  assert.ok(devices > 0, 'no device was seen');
  // Nobody moves: the page notices by itself.
  await page.evaluate(() => window.devices.at(-1).destroy());
  await until('there is another device', () => page.evaluate((n) => window.devices.length > n, devices), 60);
  await until('the picture is there', async () => psnr(before, await shot()) >= AGREE_DB, 120);
  await settled();
  assert.equal(await page.evaluate(() => window.notReloaded), true);
  assert.equal(await page.evaluate(() => window.saccade.error), null);

  // It is drawn by the new device: what changes from here on shows.
  const record = { record: 'delete', tile: 'late' };
  await appendFile(join(work.path, 'acquisition', 'tiles.jsonl'), JSON.stringify(record) + '\n');
  await settled();
  const change = psnr(before, await shot());
  assert.ok(change < AGREE_DB - 15, `the picture does not change any more: ${change} dB`);
});

test('the browser takes every shader without a word', async () => {
  assert.ok(await page.evaluate(() => window.shadersCompiled) > 0, 'no shader was seen');
  assert.deepEqual(complaints, []);
});

test('a browser without WebGPU gets a message', async () => {
  const { page } = await open(browser, { width: 600, height: 400 });
  await page.addInitScript(() => { delete Navigator.prototype.gpu; });
  await page.goto(url);
  await page.getByText(/WebGPU/).first().waitFor({ state: 'visible', timeout: 30_000 });
  const text = await page.locator('body').innerText();
  assert.match(text, /Chrome|Firefox|Safari/, 'the message says which browsers do');
});

const status = () => page.evaluate(() => JSON.parse(JSON.stringify(window.saccade?.status() ?? null)));

const served = async () => (await (await fetch(new URL('/volumes.json', url))).json()).volumes;

/** Waits until every record is taken in (each is one revision), and the page shows it completely. */
async function settled() {
  const records = (await readFile(join(work.path, 'acquisition', 'tiles.jsonl'), 'utf8')).trim().split('\n').length;
  await until('the picture is complete', async () => {
    const [{ revision }] = await served();
    const shown = await status();
    const done = revision >= records && shown?.fidelity === 'complete' && shown.revision >= revision;
    return done || { records, revision, shown };
  }, 180);
}

const exists = (file) => until(`${file} appears`, () => access(file).then(() => true, () => false), 30);

async function shot() {
  return picture(await page.screenshot());
}

async function rendered(camera) {
  const out = join(work.path, 'render.png');
  await run('render', join(work.path, 'archive'), '--camera', camera, '--transfer', TRANSFER,
    '--size', `${SIZE.width}x${SIZE.height}`, '-o', out);
  return picture(out);
}

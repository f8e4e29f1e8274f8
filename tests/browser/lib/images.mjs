// Images as other programs write them, small, and a plain server of files for them.
import { createServer } from 'node:http';
import { mkdir, readFile, writeFile } from 'node:fs/promises';
import { dirname, extname, join, normalize } from 'node:path';
import { gzipSync } from 'node:zlib';

import { grayPng } from './picture.mjs';

/** Voxels of the finest level: odd, so that chunks at the ends are cut. */
const SIZE = [93, 70, 51];
const CHUNK = 32;
const VOXEL_NM = [10, 10, 20];
/** Values at the ends of the colours that the OME-Zarr image asks for. */
export const WINDOW = [40, 220];

/** A bright shell and a bright core in the dark, with stripes that tell x, y and z apart. */
function value(x, y, z) {
  const [dx, dy, dz] = [(x - 46) / 40, (y - 35) / 30, (z - 25) / 22];
  const r = Math.hypot(dx, dy, dz);
  if (r > 1) return 12 + ((x + 2 * y + 3 * z) % 5);
  const stripes = 20 * Math.sin(x / 4) + 15 * Math.cos(y / 7);
  return Math.round((r > 0.8 || r < 0.35 ? 190 : 70) + stripes + (z > 25 ? 20 : 0));
}

/** Levels, finest first: { size, scale, at(x, y, z) }. The second averages 2 x 2 x 1 voxels. */
function levels() {
  const half = [Math.ceil(SIZE[0] / 2), Math.ceil(SIZE[1] / 2), SIZE[2]];
  const average = (x, y, z) => {
    const clamp = (v, axis) => Math.min(v, SIZE[axis] - 1);
    let sum = 0;
    for (const i of [0, 1]) for (const j of [0, 1]) sum += value(clamp(2 * x + i, 0), clamp(2 * y + j, 1), z);
    return Math.round(sum / 4);
  };
  return [
    { size: SIZE, scale: [1, 1, 1], at: value },
    { size: half, scale: [2, 2, 1], at: average },
  ];
}

/** Numbers of the chunks along an axis. */
const chunks = (size) => Array.from({ length: Math.ceil(size / CHUNK) }, (_, n) => n);

async function write(path, bytes) {
  await mkdir(dirname(path), { recursive: true });
  await writeFile(path, typeof bytes === 'object' && !Buffer.isBuffer(bytes) ? JSON.stringify(bytes) : bytes);
}

/** OME-Zarr 0.4: Zarr version 2, z, y, x, chunks of 32 x 32 x 32 by gzip, those at the ends padded. */
export async function writeZarr(folder) {
  const axes = ['z', 'y', 'x'].map((name) => ({ name, type: 'space', unit: 'nanometer' }));
  const datasets = [];
  for (const [level, { size, scale, at }] of levels().entries()) {
    const zyx = [...scale].map((s, axis) => s * VOXEL_NM[axis]).reverse();
    datasets.push({ path: `${level}`, coordinateTransformations: [{ type: 'scale', scale: zyx }] });
    await write(join(folder, `${level}`, '.zarray'), {
      zarr_format: 2, shape: [...size].reverse(), chunks: [CHUNK, CHUNK, CHUNK], dtype: '|u1', order: 'C',
      fill_value: 0, filters: null, dimension_separator: '/', compressor: { id: 'gzip', level: 5 },
    });
    for (const cz of chunks(size[2])) for (const cy of chunks(size[1])) for (const cx of chunks(size[0])) {
      const voxels = Buffer.alloc(CHUNK ** 3);
      each(CHUNK, (x, y, z) => {
        const p = [cx * CHUNK + x, cy * CHUNK + y, cz * CHUNK + z];
        if (p.every((v, axis) => v < size[axis])) voxels[(z * CHUNK + y) * CHUNK + x] = at(...p);
      });
      await write(join(folder, `${level}`, `${cz}`, `${cy}`, `${cx}`), gzipSync(voxels));
    }
  }
  await write(join(folder, '.zgroup'), { zarr_format: 2 });
  const [start, end] = WINDOW;
  const channels = [{ label: 'shell', color: 'FF00FF', active: true, window: { min: 0, max: 255, start, end } }];
  await write(join(folder, '.zattrs'), { multiscales: [{ version: '0.4', axes, datasets }], omero: { channels } });
}

/** Neuroglancer precomputed: chunks of 32 x 32 x 32 as PNG, each a file of its own, those at the ends cut. */
export async function writePrecomputed(folder) {
  const scales = [];
  for (const [level, { size, scale, at }] of levels().entries()) {
    const key = `level${level}`;
    scales.push({
      key, size, encoding: 'png', chunk_sizes: [[CHUNK, CHUNK, CHUNK]], voxel_offset: [0, 0, 0],
      resolution: scale.map((s, axis) => s * VOXEL_NM[axis]),
    });
    for (const cz of chunks(size[2])) for (const cy of chunks(size[1])) for (const cx of chunks(size[0])) {
      const from = [cx, cy, cz].map((c) => c * CHUNK);
      const to = from.map((v, axis) => Math.min(v + CHUNK, size[axis]));
      const [nx, ny, nz] = to.map((v, axis) => v - from[axis]);
      const png = grayPng(nx, ny * nz, (x, row) => at(from[0] + x, from[1] + (row % ny), from[2] + Math.floor(row / ny)));
      const name = from.map((v, axis) => `${v}-${to[axis]}`).join('_');
      await write(join(folder, key, name), png);
    }
  }
  await write(join(folder, 'info'), {
    '@type': 'neuroglancer_multiscale_volume', type: 'image', data_type: 'uint8', num_channels: 1, scales,
  });
}

function each(edge, visit) {
  for (let z = 0; z < edge; z++) for (let y = 0; y < edge; y++) for (let x = 0; x < edge; x++) visit(x, y, z);
}

const TYPES = { '.html': 'text/html', '.js': 'text/javascript', '.css': 'text/css', '.wasm': 'application/wasm' };

/**
 * Files of a folder by HTTP. `manners` may be changed while it runs: `cors`, whether pages of other hosts may read;
 * `ranges`, whether parts are sent; `preflight`, whether questions for permission are answered; `damage(path, bytes)`
 * what is sent instead; `delay` in ms. `log` has { method, path, range, ended, closed } of each request: whether its answer was sent, or its
 * connection closed.
 */
export async function serveFiles(folder, manners = {}) {
  const rules = { cors: true, ranges: true, preflight: false, delay: 0, damage: (_, bytes) => bytes, ...manners };
  const log = [];
  const server = createServer(async (request, response) => {
    const path = decodeURIComponent(new URL(request.url, 'http://host').pathname);
    const entry = { method: request.method, path, range: request.headers.range ?? null, ended: false, closed: false };
    log.push(entry);
    response.on('finish', () => { entry.ended = true; });
    response.on('close', () => { entry.closed = true; });
    if (rules.cors) response.setHeader('Access-Control-Allow-Origin', '*');
    if (request.method === 'OPTIONS') {
      if (rules.preflight) response.setHeader('Access-Control-Allow-Headers', 'range');
      return response.writeHead(rules.preflight ? 204 : 405).end();
    }
    const file = join(folder, normalize(path === '/' ? '/index.html' : path));
    let bytes = await readFile(file).catch(() => null);
    if (rules.delay > 0) await new Promise((resolve) => setTimeout(resolve, rules.delay));
    if (bytes === null) return response.writeHead(404).end('no such file');
    bytes = rules.damage(path, bytes);
    response.setHeader('Content-Type', TYPES[extname(file)] ?? 'application/octet-stream');
    const range = rules.ranges && /^bytes=(\d*)-(\d*)$/.exec(request.headers.range ?? '');
    let status = 200;
    if (range) {
      const first = range[1] === '' ? Math.max(0, bytes.length - Number(range[2])) : Number(range[1]);
      const last = Math.min(range[1] === '' || range[2] === '' ? Infinity : Number(range[2]), bytes.length - 1);
      if (first > last) return response.writeHead(416).end();
      response.setHeader('Content-Range', `bytes ${first}-${last}/${bytes.length}`);
      bytes = bytes.subarray(first, last + 1);
      status = 206;
    }
    response.writeHead(status, { 'Content-Length': bytes.length });
    response.end(request.method === 'HEAD' ? undefined : bytes);
  });
  await new Promise((resolve) => server.listen(0, '127.0.0.1', resolve));
  const stop = () => new Promise((resolve) => { server.close(resolve); server.closeAllConnections(); });
  return { url: `http://127.0.0.1:${server.address().port}`, rules, log, stop };
}

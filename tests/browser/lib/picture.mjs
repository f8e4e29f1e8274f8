// Pictures and how far apart they are.
import { readFile } from 'node:fs/promises';
import { PNG } from 'pngjs';

/** Decodes a PNG, given as bytes or as a file's name, to { width, height, data }: RGBA rows. */
export async function picture(png) {
  return PNG.sync.read(typeof png === 'string' ? await readFile(png) : png);
}

/** Peak signal-to-noise ratio over red, green and blue [dB]; Infinity for equal pictures. */
export function psnr(a, b) {
  if (a.width !== b.width || a.height !== b.height) {
    throw new Error(`pictures of ${a.width}x${a.height} and ${b.width}x${b.height} cannot be compared`);
  }
  let sum = 0;
  for (let i = 0; i < a.data.length; i++) {
    if (i % 4 !== 3) sum += (a.data[i] - b.data[i]) ** 2;
  }
  const meanSquare = sum / (a.width * a.height * 3);
  return 10 * Math.log10(255 ** 2 / meanSquare);
}

/** Part of the pixels that differ from the first one by more than a little. */
export function covered({ data }) {
  let pixels = 0;
  for (let i = 0; i < data.length; i += 4) {
    const difference = [0, 1, 2].map((c) => Math.abs(data[i + c] - data[c]));
    if (Math.max(...difference) > 12) pixels++;
  }
  return pixels / (data.length / 4);
}

/** A gray picture as PNG: `value(x, y)` in 0 to 255. */
export function grayPng(width, height, value) {
  const png = new PNG({ width, height });
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      png.data.fill(value(x, y), 4 * (y * width + x), 4 * (y * width + x) + 3);
      png.data[4 * (y * width + x) + 3] = 255;
    }
  }
  return PNG.sync.write(png, { colorType: 0, inputHasAlpha: true });
}

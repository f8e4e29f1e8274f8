// Chromium with WebGPU in software.
import { chromium } from 'playwright-core';

// Tried together: with other sets the GPU process crashes or the canvas stays blank.
const FLAGS = [
  '--headless=new',
  '--no-sandbox',
  '--enable-unsafe-webgpu',
  '--use-webgpu-adapter=swiftshader',
  '--enable-features=Vulkan',
  '--use-vulkan=swiftshader',
  '--use-angle=swiftshader',
  '--ignore-gpu-blocklist',
  '--enable-unsafe-swiftshader',
  '--disable-background-networking',
  '--disable-component-update',
  '--disable-sync',
  '--no-first-run',
];

export async function launch() {
  return chromium.launch({
    executablePath: process.env.SACCADE_CHROMIUM || '/usr/bin/chromium',
    args: FLAGS,
    ignoreDefaultArgs: ['--headless', '--headless=old', '--enable-automation'],
  });
}

/** A page of `width` x `height` pixels; `complaints` collects its errors and warnings. */
export async function open(browser, { width, height }) {
  const context = await browser.newContext({ viewport: { width, height }, deviceScaleFactor: 1 });
  const page = await context.newPage();
  const complaints = [];
  page.on('console', (message) => {
    const text = message.text();
    // The adapter of this test is software, and the window library says so.
    if (['error', 'warning'].includes(message.type()) && !/Software rasterizer/.test(text)) {
      complaints.push(`${message.type()}: ${text}`);
    }
  });
  page.on('pageerror', (error) => complaints.push(`uncaught: ${error.message}`));
  return { page, complaints };
}

/** Keeps the devices that the page was given in `window.devices`, the newest last. */
export async function rememberDevices(page) {
  await page.addInitScript(() => {
    window.devices = [];
    const request = globalThis.GPUAdapter?.prototype.requestDevice;
    if (!request) return;
    GPUAdapter.prototype.requestDevice = async function (...descriptor) {
      const device = await request.apply(this, descriptor);
      window.devices.push(device);
      return device;
    };
  });
}

/** Makes every shader's compilation messages complaints: a browser keeps warnings to itself. */
export async function reportShaders(page) {
  await page.addInitScript(() => {
    window.shadersCompiled = 0;
    const create = globalThis.GPUDevice?.prototype.createShaderModule;
    if (!create) return;
    GPUDevice.prototype.createShaderModule = function (descriptor) {
      const module = create.call(this, descriptor);
      module.getCompilationInfo().then(({ messages }) => {
        window.shadersCompiled++;
        for (const { type, lineNum, message } of messages) {
          console.error(`shader ${descriptor.label ?? ''} line ${lineNum}: ${type}: ${message}`);
        }
      });
      return module;
    };
  });
}

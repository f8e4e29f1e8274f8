// Starts the application, and says in plain words why it cannot start.
import init, { decoders, start, status } from "./saccade_view.js";

const message = document.getElementById("message");
const form = document.getElementById("open");

function fail(text) {
  document.getElementById("words").textContent = text;
  message.className = "error";
  message.hidden = false;
  window.saccade.error = text;
}

let loaded = false;

// For scripts: what the picture shows right now, or null before the first one.
window.saccade = {
  error: null,
  status: () => {
    const json = loaded ? status() : "";
    return json ? JSON.parse(json) : null;
  },
  // How many chunks workers decoded, and how many this page.
  decoders: () => (loaded ? JSON.parse(decoders()) : null),
};

window.saccadeLost = () =>
  fail("The graphics device was lost again and again.\nReload the page. If it happens again, close other tabs that draw, or update the graphics driver.");

const noWebGpu = `Saccade draws with WebGPU, and this browser does not offer it here.

It is on by default in Chrome and Edge 113 or later, Safari 26 or later, and Firefox 141 or later on Windows, 145 or later on macOS.
On Linux, Chrome may need chrome://flags/#enable-unsafe-webgpu and chrome://flags/#enable-vulkan; Firefox needs dom.webgpu.enabled in about:config, or Nightly.`;

const insecure = `Saccade draws with WebGPU, which browsers offer to secure pages only.
Open this page over https, or through localhost (for a remote machine: ssh -L 8080:localhost:8080).`;

const noAdapter = `Saccade draws with WebGPU. This browser has it, but found no graphics device for it.

Allow graphics acceleration in the browser's settings, and see chrome://gpu (Chrome, Edge) or about:support (Firefox) for what is switched off. Without a graphics card, install a software Vulkan driver (Debian and Ubuntu: apt-get install mesa-vulkan-drivers).`;

async function main() {
  if (!window.isSecureContext) return fail(insecure);
  if (!navigator.gpu) return fail(noWebGpu);
  if (!(await navigator.gpu.requestAdapter())) return fail(noAdapter);
  try {
    await init();
    loaded = true;
    await start("saccade");
    message.hidden = true;
  } catch (error) {
    console.error(error);
    fail(`Saccade could not start.\n\n${error instanceof Error ? error.message : error}`);
    // What was asked for may be what is wrong.
    form.elements.source.value = new URLSearchParams(location.search).get("source") ?? "";
    form.hidden = false;
  }
}

main();

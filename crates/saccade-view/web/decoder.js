// A worker that decodes chunks, so that the page need not: the same module, instantiated once more.
import init, { decode, prepare_decoder } from "./saccade_view.js";

let ready;

onmessage = async ({ data: [first, task, bytes] }) => {
  if (first instanceof WebAssembly.Module) {
    ready = init({ module_or_path: first }).then(prepare_decoder);
    await ready;
    postMessage([]);
    return;
  }
  try {
    await ready;
    const voxels = decode(task, bytes);
    postMessage([first, voxels], [voxels.buffer]);
  } catch (error) {
    // Words are what is wrong with the chunk; anything else, that this worker is not to be used any more.
    postMessage(typeof error === "string" ? [first, error] : [first]);
    if (typeof error !== "string") console.error(error);
  }
};

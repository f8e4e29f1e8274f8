// The command line, as a user runs it.
import { spawn } from 'node:child_process';
import { mkdtemp, rm } from 'node:fs/promises';
import { tmpdir } from 'node:os';
import { join } from 'node:path';

const BIN = process.env.SACCADE_BIN;
if (!BIN) throw new Error('SACCADE_BIN must name the saccade binary; ./dev test sets it');

/** A running `saccade`, with what it has printed so far. */
export class Process {
  constructor(args) {
    this.args = args;
    this.output = '';
    this.child = spawn(BIN, args, { stdio: ['ignore', 'pipe', 'pipe'] });
    for (const stream of [this.child.stdout, this.child.stderr]) {
      stream.on('data', (text) => { this.output += text; });
    }
    this.ended = new Promise((resolve) => this.child.on('close', resolve));
  }

  /** Waits for its end, which must be a good one. */
  async success() {
    const code = await this.ended;
    if (code !== 0) throw new Error(`saccade ${this.args.join(' ')} ended with ${code}:\n${this.output}`);
    return this.output;
  }

  /** Waits until it has printed something that matches. */
  async printed(pattern, seconds = 30) {
    for (const end = Date.now() + 1000 * seconds; Date.now() < end; await sleep(50)) {
      const match = this.output.match(pattern);
      if (match) return match;
      if (this.child.exitCode !== null) break;
    }
    throw new Error(`saccade ${this.args.join(' ')} did not print ${pattern}:\n${this.output}`);
  }

  async stop() {
    if (this.child.exitCode === null) this.child.kill('SIGTERM');
    await this.ended;
  }
}

export const run = (...args) => new Process(args).success();
export const start = (...args) => new Process(args);

export const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** A folder that `release` removes. */
export async function folder() {
  const path = await mkdtemp(join(tmpdir(), 'saccade-browser-'));
  return { path, release: () => rm(path, { recursive: true, force: true }) };
}

/** Polls until `condition` is true. */
export async function until(what, condition, seconds) {
  let last;
  for (const end = Date.now() + 1000 * seconds; Date.now() < end; await sleep(200)) {
    last = await condition();
    if (last === true) return;
  }
  throw new Error(`after ${seconds} s still waiting: ${what} (${JSON.stringify(last)})`);
}

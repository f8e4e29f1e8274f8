"""Archives in an object store, with and without faults."""

import json
import os
import random
import subprocess
import time
import unittest
import urllib.error
import urllib.request

import numpy as np
from PIL import Image

from archive import BIN, BUCKET, SEED, ArchiveTest, Proxy, run
from lib.saccade import until

KILLS = int(os.environ.get("SACCADE_TEST_KILLS", 8))
CAMERA = ["--size", "320x240"]


class S3(ArchiveTest):
    @classmethod
    def acquire(cls):
        made = run("simulate", cls.acquisition, "--phantom", "--name", "tissue", "--extent", "601,403,20", "--voxel-nm",
                   "8,8,40", "--tile", "256x256", "--rate", "max", "--corrections", "never", "--seed", "7")
        assert made.returncode == 0, made.stderr

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        assert len(cls.want) >= 100, len(cls.want)

    def picture(self, *archive):
        out = self.work / f"{self.prefix}.png"
        drawn = run("render", *archive, "-o", out, *CAMERA)
        self.assertEqual(drawn.returncode, 0, drawn.stderr)
        return np.asarray(Image.open(out).convert("L"), np.int16)

    def test_a_bucket_serves_as_a_folder_does(self):
        done = run("ingest", self.acquisition, *self.archive, "--once")
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertIn(f"s3://{BUCKET}/{self.prefix}", done.stderr)
        self.complete()
        self.assertEqual(self.proxy.requests["PUT"], len(self.want) + 1, "one request a pyramid, and one for the mark")
        fresh = self.work / "fresh.sqlite"
        again = run("ingest", self.acquisition, self.archive[0], "--once", "--catalog", fresh)
        self.assertEqual(again.returncode, 1, again.stderr)
        self.assertIn("another catalog's", again.stderr)
        self.assertFalse(fresh.exists(), "a catalog is left behind")
        self.proxy.requests.clear()
        self.proxy.latency = 0.02
        began = time.monotonic()
        picture = self.picture(*self.archive)
        print(f"\na picture of {len(self.want)} tiles at 20 ms: {dict(self.proxy.requests)}, {time.monotonic() - began:.1f} s")
        here = self.picture(self.local)
        self.assertLess(np.abs(picture - here).mean(), 0.5, "grey levels")
        self.assertGreater(np.abs(picture - here[::-1]).mean(), 2, "the comparison shows nothing")
        served = [self.start("serve", *archive, "--port", "0").printed(r"http://[\w.:]+")
                  for archive in [self.archive, [self.local]]]
        for key in chunks(served[0]):
            there, here = [chunk(url, key) for url in served]
            self.assertEqual(there, here, key)
            self.assertTrue(here and any(here), key)
        code, said = self.checked()
        self.assertEqual(code, 0, said)
        lost = self.named()[5]
        self.store.request("DELETE", f"/{BUCKET}/{self.prefix}/{lost}")
        code, said = self.checked()
        self.assertEqual(code, 3, said)
        self.assertRegex(said, f"missing: tile .* of tissue .{lost}.")

    def test_killed_while_it_writes(self):
        random.seed(SEED)
        self.proxy.latency = 0.02
        undone = 0
        for kill in range(KILLS):
            # What is complete leaves nothing to kill: another archive then.
            if len(self.named()) == len(self.want):
                self.finish()
                self.name_archive(f"{self._testMethodName}-{kill}")
            before = len(self.named())
            ingest = self.start("ingest", self.acquisition, *self.archive)
            more = random.randrange(1, 12)
            until("some tiles", lambda: len(self.named()) >= min(before + more, len(self.want)))
            ingest.child.kill()
            ingest.child.wait()
            undone += self.whole() < len(self.want)
        self.assertGreater(undone, KILLS / 2, "kills found nothing undone")
        self.proxy.latency = 0
        self.finish()

    def finish(self):
        done = run("ingest", self.acquisition, *self.archive, "--once")
        self.assertEqual(done.returncode, 0, done.stderr)
        self.complete()

    def test_faults(self):
        os.environ["AWS_TIMEOUT"] = "1s"
        self.addCleanup(os.environ.pop, "AWS_TIMEOUT")
        # Without faults first, so that there is something to serve.
        ingest = self.start("ingest", self.acquisition, *self.archive, "--workers", "4")
        until("a few tiles", lambda: len(self.named()) > 10)
        # Everything fails: it waits and says why.
        self.proxy.faults = {"busy": 1}
        ingest.printed("object store")
        ingest.printed("503")
        waiting = len(self.named())
        time.sleep(1)
        self.assertEqual(len(self.named()), waiting, "the store refuses everything")
        self.assertTrue(ingest.running())
        # Much fails: it goes on.
        self.proxy.faults = dict(zip(Proxy.FAULTS, [0.1, 0.1, 0.1, 0.05, 0.02]))
        served = [self.start("serve", *archive, "--port", "0").printed(r"http://[\w.:]+")
                  for archive in [self.archive, [self.local]]]
        failed = same = 0
        complete_since = None
        ends = time.monotonic() + 60
        while len(self.named()) < len(self.want) or same < 40:
            self.assertLess(time.monotonic(), ends, f"{len(self.named())} of {len(self.want)}, {same} chunks")
            if complete_since is None and len(self.named()) == len(self.want):
                complete_since = time.monotonic()
            for key in chunks(served[0]):
                asked = time.monotonic()
                got, want = [chunk(url, key) for url in served]
                failed += got is None
                # The servers hear of the last tile within a second of its being in the catalog.
                settled = complete_since is not None and asked - complete_since > 2
                if settled and got is not None:
                    # Also what was read before, with faults, and remembered.
                    self.assertEqual(got, want)
                    same += 1
        for fault in Proxy.FAULTS:
            self.assertGreater(self.proxy.done[fault], 0, f"{fault} never happened")
        print(f"\n{dict(self.proxy.done)} among {sum(self.proxy.requests.values())} requests, {failed} chunks failed")
        self.proxy.faults = {}
        ingest.printed("is written now")
        ingest.stop()
        self.complete()

    def test_what_cannot_work_says_how_to_mend_it(self):
        here = self.work / "none.sqlite"
        for faults, args, env, said in [
            ({}, [f"s3://{BUCKET}/x"], {}, "--catalog"),
            ({}, ["s3://nobody/x", "--catalog", here], {}, "no such bucket"),
            ({"denied": 1}, [f"s3://{BUCKET}/x", "--catalog", here], {}, "AWS_SECRET_ACCESS_KEY"),
            ({}, [f"s3://{BUCKET}/x", "--catalog", here], {"AWS_ACCESS_KEY_ID": "", "AWS_SECRET_ACCESS_KEY": ""}, "no credentials"),
            ({}, ["s3:/x", "--catalog", here], {}, "s3://bucket"),
            ({}, ["gs://x/y", "--catalog", here], {}, "s3://bucket"),
        ]:
            self.proxy.faults = faults
            done = run("ingest", self.acquisition, *args, "--once", **env)
            self.assertNotEqual(done.returncode, 0, args)
            self.assertIn(said, done.stderr)
            self.assertNotIn("panicked", done.stderr)
            self.assertFalse(here.exists(), "a catalog was left behind")

    def test_a_store_that_is_away_at_the_start_is_waited_for(self):
        here = self.work / "away.sqlite"
        # Nobody listens there.
        env = {**os.environ, "AWS_ENDPOINT_URL": "http://127.0.0.1:9"}
        run = [BIN, "ingest", self.acquisition, f"s3://{BUCKET}/x", "--catalog", here, "--once"]
        with subprocess.Popen([*map(str, run)], stderr=subprocess.PIPE, text=True, env=env) as waits:
            told = waits.stderr.readline()
            self.assertIn("network", told)
            self.assertIn("trying again", told)
            self.assertIsNone(waits.poll())
            waits.terminate()
            self.assertNotIn("panicked", waits.stderr.read())
        self.assertFalse(here.exists(), "a catalog was left behind")


def chunks(url):
    """Keys of the chunks of level 0 along a diagonal."""
    with urllib.request.urlopen(f"{url}/v/tissue/volume.json", timeout=60) as answer:
        volume = json.load(answer)["volume"]
    counts = [-(-voxels // edge) for voxels, edge in zip(volume["levels"][0]["extent"], volume["chunk"])]
    return [f"0/c/0/{n % counts[2]}/{n % counts[1]}/{n % counts[0]}" for n in range(max(counts))]


def chunk(url, key):
    """A chunk's bytes, empty if nothing was acquired there, None if it failed."""
    try:
        with urllib.request.urlopen(f"{url}/v/tissue/zarr/{key}", timeout=60) as answer:
            return answer.read()
    except urllib.error.HTTPError as error:
        return b"" if error.code == 404 else None


if __name__ == "__main__":
    unittest.main(verbosity=2)

"""Pyramids that are so large that they are sent in parts, with faults at each step, and a client that dies between them."""

import json
import os
import unittest

import numpy as np
from PIL import Image

from archive import ArchiveTest, BUCKET, Proxy, run
from lib.saccade import until

# Tiles of noise, which no codec makes smaller: the pyramid of one has more than 16 MiB.
EDGE = 2600
WHOLE = 16 << 20
PART = 8 << 20
STEPS = ["begin", "part", "complete"]
# What a fault does at each step; dripping takes an answer, of which these have little.
FAULTS = [fault for fault in Proxy.FAULTS if fault != "drip"]


class Parts(ArchiveTest):
    @classmethod
    def acquire(cls):
        (cls.acquisition / "tiles").mkdir(parents=True)
        (cls.acquisition / "volume.json").write_text(json.dumps(
            {"name": "noise", "extent": [EDGE, EDGE, len(FAULTS)], "voxel_nm": [4, 4, 40], "dtype": "uint16"}))
        noise = np.random.default_rng(7)
        with open(cls.acquisition / "tiles.jsonl", "w") as records:
            for section in range(len(FAULTS)):
                file = f"tiles/s{section}.tif"
                pixels = noise.integers(0, 1 << 16, (EDGE, EDGE), np.uint16)
                Image.fromarray(pixels).save(cls.acquisition / file)
                records.write(json.dumps({"record": "tile", "tile": f"s{section}", "file": file, "section": section,
                                          "size": [EDGE, EDGE], "transform": [1, 0, 0, 1, 0, 0]}) + "\n")

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        assert len(cls.want) == len(FAULTS), len(cls.want)
        sizes = [len(pyramid) for pyramid in cls.want.values()]
        assert WHOLE < min(sizes) < max(sizes) < 3 * PART, f"of sizes {sizes} none tests what it is to"

    def setUp(self):
        super().setUp()
        self.addCleanup(self.forget)

    def forget(self):
        """The server keeps all in memory."""
        for name in self.store.names(self.prefix):
            self.store.request("DELETE", f"/{BUCKET}/{self.prefix}/{name}")

    def path(self, name):
        return f"/{BUCKET}/{self.prefix}/{name}"

    def tile_of(self, path):
        """A pyramid's number."""
        return sorted(map(self.path, self.want)).index(path)

    def nothing_half(self):
        """What is listed is whole, and what the catalog names is listed."""
        names = self.store.names(self.prefix)
        for name in names:
            if name != "identity":
                self.assertEqual(self.store.object(self.prefix, name), self.want[name], name)
        self.assertLessEqual(set(self.named()), set(names))

    def test_in_parts(self):
        done = run("ingest", self.acquisition, *self.archive, "--once")
        self.assertEqual(done.returncode, 0, done.stderr)
        self.complete()
        kinds = [kind for kind, _ in self.proxy.kinds.elements()]
        self.assertEqual({step: kinds.count(step) for step in STEPS},
                         {"begin": len(self.want), "part": 3 * len(self.want), "complete": len(self.want)})
        self.assertEqual(self.store.uploads(self.prefix), [])
        code, said = self.checked()
        self.assertEqual(code, 0, said)

    def test_every_fault_at_every_step(self):
        def order(kind, path, nth):
            # Another fault for each tile at each step; in the end each fault at each.
            if kind in STEPS and nth == 0:
                return FAULTS[(self.tile_of(path) + STEPS.index(kind)) % len(FAULTS)]
            return None

        self.proxy.order = order
        done = run("ingest", self.acquisition, *self.archive, "--once")
        self.assertEqual(done.returncode, 0, done.stderr)
        self.complete()
        for step in STEPS:
            for fault in FAULTS:
                self.assertEqual(self.proxy.done[step, fault], 1, f"{fault} at {step}")
        begun = sum(n for (kind, _), n in self.proxy.kinds.items() if kind == "begin")
        self.assertEqual(begun, len(self.want) + len(FAULTS), "what the store has is not sent again")
        # Whose number nobody was told: without parts.
        self.assertEqual(self.store.uploads(self.prefix), [[], []], "one lost, one cut short")
        code, said = self.checked()
        self.assertEqual(code, 0, said)
        self.assertNotIn("object store does not", done.stderr, "nothing that passes is told as an outage")

    def test_a_step_that_fails_for_long(self):
        for step in STEPS:
            with self.subTest(step):
                self.name_archive(f"{self._testMethodName}-{step}")
                self.proxy.order = lambda kind, *_: "busy" if kind == step else None
                ingest = self.start("ingest", self.acquisition, *self.archive, "--workers", "1")
                ingest.printed("503")
                self.assertTrue(ingest.running())
                self.assertEqual(self.named(), [])
                self.assertEqual([name for name in self.store.names(self.prefix) if name != "identity"], [])
                self.proxy.order = lambda *_: None
                ingest.printed("is written now")
                until("it is acknowledged", self.named)
                ingest.stop()
                self.nothing_half()
                self.assertEqual(self.store.uploads(self.prefix), [], "what was given up is aborted")
                self.forget()

    def test_stopped_between_parts(self):
        self.proxy.order = lambda kind, _, nth: "hold" if kind == "part" and nth == 2 else None
        ingest = self.start("ingest", self.acquisition, *self.archive, "--workers", "2")
        until("two uploads wait for their last part", lambda: self.proxy.done["part", "hold"] == 2)
        self.assertEqual(len(self.store.uploads(self.prefix)), 2)
        ingest.stop()
        self.assertEqual(ingest.child.returncode, 0)
        self.assertEqual(self.store.uploads(self.prefix), [], "who ends in peace leaves nothing")
        self.nothing_half()

    def test_stopped_before_an_upload_has_its_number(self):
        self.proxy.order = lambda kind, _, nth: "late" if kind == "begin" and nth == 0 else None
        ingest = self.start("ingest", self.acquisition, *self.archive, "--workers", "1")
        until("the store has begun one and tells nobody", lambda: self.store.uploads(self.prefix))
        ingest.stop()
        self.assertEqual(ingest.child.returncode, 0)
        self.assertEqual(self.store.uploads(self.prefix), [], "the number is waited for")
        self.nothing_half()

    def test_killed_between_parts(self):
        kills = [("begin", 0, "hold"), ("part", 0, "hold"), ("part", 1, "hold"), ("part", 2, "withhold"),
                 ("complete", 0, "hold"), ("complete", 0, "withhold")]
        left = []
        for step, after, fault in kills:
            held = set()

            def order(kind, path, nth):
                # The first tile passes, and is acknowledged from then on.
                if kind != step or nth < after or self.tile_of(path) == 0:
                    return None
                held.add(path)
                return fault

            self.restart_proxy()
            self.proxy.order = order
            before = set(self.named())
            ingest = self.start("ingest", self.acquisition, *self.archive, "--workers", "1")
            until(f"{fault} at {step}", lambda: held)
            until("the tile before is acknowledged", self.named)
            if fault == "withhold":
                until("the store has done it", lambda: self.proxy.withheld)
            ingest.child.kill()
            ingest.child.wait()
            now = set(self.named())
            self.assertLessEqual(before, now)
            self.assertFalse(held & set(map(self.path, now)), "it is acknowledged before its time")
            self.nothing_half()
            code, said = self.checked()
            self.assertEqual(code, 0, said)
            left.append(self.store.uploads(self.prefix))
        print(f"\nparts left after each kill: {left}")
        self.assertTrue(any(left[-1]), "no kill came between parts")
        self.restart_proxy()
        done = run("ingest", self.acquisition, *self.archive, "--once")
        self.assertEqual(done.returncode, 0, done.stderr)
        self.complete()
        # What killed processes began is nobody's, and harms nobody.
        self.assertEqual(self.store.uploads(self.prefix), left[-1])
        code, said = self.checked()
        self.assertEqual(code, 0, said)

    def restart_proxy(self):
        """Lets go of what it holds."""
        self.proxy.close()
        self.proxy = Proxy(self.store, 0)
        self.addCleanup(self.proxy.close)
        os.environ["AWS_ENDPOINT_URL"] = self.proxy.url


if __name__ == "__main__":
    unittest.main(verbosity=2)

"""Images that others wrote, read from an object store: signed, anonymous, refused and out of breath."""

import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from urllib.parse import quote

import numpy as np
import tensorstore
import zarr
from PIL import Image

sys.path.append(str(Path(__file__).parents[1] / "clients"))
from lib.saccade import BIN  # noqa: E402
from store import BUCKET, KEY, PUBLIC, Proxy, Store  # noqa: E402

SIGNED = dict(zip(("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), KEY))
# Odd on every axis, z y x.
SHAPE = (27, 75, 141)


def voxels():
    """Never 0, and different everywhere."""
    z, y, x = np.indices(SHAPE)
    return (1 + (z * 8191 + y * 131 + x * 7 + x * y) % 65_000).astype(np.uint16)


def write_zarr(folder, zarr_format):
    """An image of two levels: version 0.5 in shards, or 0.4."""
    group = zarr.create_group(folder, zarr_format=zarr_format)
    datasets = []
    for level, array in enumerate([voxels(), voxels()[:, ::2, ::2]]):
        form = {"chunks": (8, 32, 32), "shards": (16, 64, 128)} if zarr_format == 3 else {"chunks": (8, 33, 40)}
        group.create_array(str(level), shape=array.shape, dtype=array.dtype, **form)[:] = array
        scale = [40.0, 8.0 * 2**level, 8.0 * 2**level]
        datasets.append({"path": str(level), "coordinateTransformations": [{"type": "scale", "scale": scale}]})
    axes = [{"name": name, "type": "space", "unit": "nanometer"} for name in "zyx"]
    image = {"multiscales": [{"version": "0.4", "name": "image", "axes": axes, "datasets": datasets}]}
    group.attrs.update({"ome": {"version": "0.5", **image}} if zarr_format == 3 else image)


def write_precomputed(folder):
    """A sharded volume of one level."""
    spec = {
        "driver": "neuroglancer_precomputed",
        "kvstore": {"driver": "file", "path": f"{folder}/"},
        "multiscale_metadata": {"type": "image", "data_type": "uint16", "num_channels": 1},
        "scale_metadata": {
            "resolution": [8, 8, 40], "encoding": "raw", "chunk_size": [64, 32, 8], "size": SHAPE[::-1],
            "sharding": {"@type": "neuroglancer_uint64_sharded_v1", "preshift_bits": 1, "minishard_bits": 1,
                         "shard_bits": 1, "hash": "identity", "minishard_index_encoding": "gzip", "data_encoding": "gzip"},
        },
    }
    store = tensorstore.open(spec, create=True).result()
    store[...] = voxels().transpose()[..., None]


class Images(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory(prefix="saccade-s3-images-")
        cls.addClassCleanup(folder.cleanup)
        cls.work = Path(folder.name)
        cls.store = Store()
        cls.addClassCleanup(cls.store.close)
        for name in [name for name in os.environ if name.startswith("AWS_")]:
            del os.environ[name]
        cls.images = ["v3.ome.zarr", "v2.ome.zarr", "precomputed"]
        write_zarr(cls.work / "v3.ome.zarr", 3)
        write_zarr(cls.work / "v2.ome.zarr", 2)
        write_precomputed(cls.work / "precomputed")
        for name in cls.images:
            for bucket in [BUCKET, PUBLIC]:
                cls.store.put_folder(cls.work / name, bucket, f"data/{name}")

    def setUp(self):
        self.proxy = Proxy(self.store, 0)
        self.proxy.checks = True
        self.addCleanup(self.proxy.close)

    def run_saccade(self, *args, **env):
        env = {**os.environ, "AWS_ENDPOINT_URL": self.proxy.url, "AWS_EC2_METADATA_DISABLED": "true", **env}
        done = subprocess.run([BIN, *map(str, args)], capture_output=True, text=True, timeout=120, env=env)
        self.assertNotIn("panicked", done.stderr)
        return done

    def exported(self, place, **env):
        """Voxels of the finest level."""
        with tempfile.TemporaryDirectory(dir=self.work) as out:
            done = self.run_saccade("export", place, out, **env)
            self.assertEqual(done.returncode, 0, f"{place}: {done.stderr}")
            array = zarr.open_group(out, mode="r")["0"][:]
        self.assertEqual(array.shape[0], 1, "channels")
        return array[0]

    def rendered(self, place, **env):
        out = self.work / "picture.png"
        done = self.run_saccade("render", place, "-o", out, "--size", "160x120", **env)
        self.assertEqual(done.returncode, 0, f"{place}: {done.stderr}")
        return np.asarray(Image.open(out).convert("L"), np.int16)

    def said(self, *args, **env):
        """What is said of a failure."""
        done = self.run_saccade(*args, **env)
        self.assertNotEqual(done.returncode, 0, args)
        return done.stderr

    def test_signed(self):
        for name in self.images:
            place = f"s3://{BUCKET}/data/{name}"
            np.testing.assert_array_equal(self.exported(place, **SIGNED), voxels(), name)
            here = self.rendered(self.work / name)
            self.assertLess(np.abs(self.rendered(place, **SIGNED) - here).mean(), 0.5, name)
            self.assertGreater(np.abs(here - here[::-1]).mean(), 2, "the comparison shows nothing")
        self.assertEqual(set(self.proxy.answers), {(True, None)}, "every signature holds")

    def test_names_are_as_they_are(self):
        prefix = "Gewebe_ä/50%20#1+"
        quoted = quote(prefix)
        self.store.put_folder(self.work / self.images[0], BUCKET, quoted)
        place = f"s3://{BUCKET}/{prefix}"
        np.testing.assert_array_equal(self.exported(place, **SIGNED), voxels())
        done = self.run_saccade("export", self.work / self.images[0], f"{place}/copy", **SIGNED)
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertEqual(self.store.request("HEAD", f"/{BUCKET}/{quoted}/copy/zarr.json")[0], 200)
        np.testing.assert_array_equal(self.exported(f"{place}/copy", **SIGNED), voxels())

    def test_anonymous(self):
        for name in self.images:
            np.testing.assert_array_equal(self.exported(f"s3://{PUBLIC}/data/{name}"), voxels(), name)
        self.assertEqual(set(self.proxy.answers), {(False, None)}, "nothing is signed")

    def test_what_is_refused_says_how_to_mend_it(self):
        name = self.images[0]
        place = f"s3://{BUCKET}/data/{name}"
        wrong = [
            ({**SIGNED, "AWS_SECRET_ACCESS_KEY": "wrong"}, (True, "SignatureDoesNotMatch")),
            ({**SIGNED, "AWS_ACCESS_KEY_ID": "nobody"}, (True, "InvalidAccessKeyId")),
            ({}, (False, "AccessDenied")),
        ]
        for env, answer in wrong:
            self.proxy.answers.clear()
            said = self.said("export", place, self.work / "none", **env)
            self.assertEqual(set(self.proxy.answers), {answer})
            for words in ["denied", "AWS_SECRET_ACCESS_KEY", place]:
                self.assertIn(words, said)
        for bucket in ["nobody", "no.such.bucket"]:
            said = self.said("render", f"s3://{bucket}/x", "-o", self.work / "none.png", **SIGNED)
            for words in ["no such bucket", "check its name", f"s3://{bucket}/x"]:
                self.assertIn(words, said)
        said = self.said("render", f"s3://{BUCKET}/data/nothing", "-o", self.work / "none.png", **SIGNED)
        for words in ["zarr.json", "info", f"s3://{BUCKET}/data/nothing"]:
            self.assertIn(words, said)
        self.assertNotIn("denied", said)
        said = self.said("export", place, self.work / "none", **SIGNED, AWS_ENDPOINT_URL="http://127.0.0.1:9")
        for words in ["not read in", place]:
            self.assertIn(words, said)

    def test_what_is_busy_is_asked_again(self):
        self.proxy.busy_at_first = True
        for name in self.images:
            self.proxy.asked.clear()
            place = f"s3://{BUCKET}/data/{name}"
            np.testing.assert_array_equal(self.exported(place, **SIGNED), voxels(), name)
            self.assertGreater(len(self.proxy.asked), 3, "too few requests to say anything")
            self.assertGreaterEqual(min(self.proxy.asked.values()), 2, "each was refused at first")
        self.proxy.busy_at_first = False
        self.proxy.faults = {"busy": 1}
        said = self.said("export", place, self.work / "none", **SIGNED)
        for words in ["not read in 5 attempts", "503", place]:
            self.assertIn(words, said)

    def test_what_changed_is_noticed(self):
        for name, key in zip(self.images, ["0/c/0/0/0", "0/0.0.0", None]):
            prefix = f"changed/{name}"
            place = f"s3://{BUCKET}/{prefix}"
            self.store.put_folder(self.work / name, BUCKET, prefix)
            if key is None:
                [key, *_] = sorted(name for name in self.store.names(prefix) if name.endswith(".shard"))
            whole = self.store.object(prefix, key)
            # Another's bytes in its place are other voxels; there, and nowhere else.
            if name.endswith(".zarr"):
                other = key[:-1] + "1"
                self.store.request("PUT", f"/{BUCKET}/{prefix}/{key}", self.store.object(prefix, other))
                different = self.exported(place, **SIGNED) != voxels()
                end = (16, 64, 128) if "v3" in name else (8, 33, 40)
                inside = tuple(slice(0, n) for n in end)
                self.assertGreater(different[inside].mean(), 0.9, name)
                different[inside] = False
                self.assertFalse(different.any(), name)
            # Damage is no picture, and is named.
            damaged = bytearray(whole)
            for at in range(0, len(damaged), 37):
                damaged[at] ^= 0x55
            self.store.request("PUT", f"/{BUCKET}/{prefix}/{key}", bytes(damaged))
            said = self.said("export", place, self.work / f"none-{name}", **SIGNED)
            for words in ["chunk", f"{place}/{key}"]:
                self.assertIn(words, said)


if __name__ == "__main__":
    unittest.main(verbosity=2)

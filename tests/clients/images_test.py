"""Images that other programs wrote, opened by Saccade and compared voxel by voxel with what those programs read.

What Saccade makes of an image is taken from its export, which zarr-python reads.
"""

import gzip
import json
import shutil
import subprocess
import tempfile
import unittest
from pathlib import Path

import numcodecs
import numpy as np
import tensorstore
import zarr
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, GzipCodec, TransposeCodec, ZstdCodec

from lib.saccade import BIN

# Real images, not part of the repository.
DATA = Path(__file__).parents[2] / "../shared/data"
# Odd on every axis, and no multiple of anything.
LENGTHS = {"t": 2, "c": 3, "z": 9, "y": 41, "x": 75}
CHUNKS = {"t": 1, "c": 2, "z": 4, "y": 16, "x": 24}
SHARDS = {"t": 1, "c": 2, "z": 8, "y": 32, "x": 72}


def each(axes, lengths):
    return tuple(lengths[axis] for axis in axes)


def values(axes, dtype):
    """Noise in one half, and steps in the other: chunks that compress and some that do not."""
    shape = each(axes, LENGTHS)
    random = np.random.default_rng(sum(map(ord, axes + dtype)))
    kind = np.dtype(dtype)
    if kind.kind == "f":
        noise = random.normal(3, 50, shape)
    else:
        narrow = kind.itemsize <= 2
        low = np.iinfo(kind).min if kind.kind == "i" and narrow else 0
        noise = random.integers(low, np.iinfo(kind).max if narrow else 60_000, shape, endpoint=True)
    steps = np.indices(shape).sum(axis=0) // 5 + 1
    return np.where(np.indices(shape)[axes.index("x")] % 50 < 25, noise, steps).astype(kind)


def attributes(axes, levels=("0",)):
    kinds = {"t": "time", "c": "channel"}
    named = [{"name": axis, "type": kinds.get(axis, "space"), **({} if axis in kinds else {"unit": "nanometer"})}
             for axis in axes]
    scale = [[1.0 if axis in kinds else 4.0 * 2**n for axis in axes] for n in range(len(levels))]
    datasets = [{"path": path, "coordinateTransformations": [{"type": "scale", "scale": scale[n]}]}
                for n, path in enumerate(levels)]
    return {"multiscales": [{"version": "0.4", "name": "image", "axes": named, "datasets": datasets}]}


def group_of(folder, zarr_format, said):
    group = zarr.create_group(folder, zarr_format=zarr_format)
    group.attrs.update({"ome": {**said, "version": "0.5"}} if zarr_format == 3 else said)
    return group


def moved_to_czyx(array, axes):
    """Of several times the first; axes that there are not have a length of 1."""
    if "t" in axes:
        array = np.take(array, 0, axes.index("t"))
        axes = axes.replace("t", "")
    array = np.transpose(array, sorted(range(len(axes)), key=lambda n: "czyx".index(axes[n])))
    return array.reshape([1 if axis not in axes else array.shape[sorted(axes, key="czyx".index).index(axis)]
                          for axis in "czyx"])


def shown(array, labels=False):
    """What Saccade says that it shows of such numbers."""
    kind = array.dtype
    if kind.kind == "f":
        low, high = np.float64(np.nanmin(array)), np.float64(np.nanmax(array))
        share = (array.astype(np.float64) - low) / (high - low)
        zero = (array == 0) & (low > 0)
        return np.where(np.isnan(array) | zero, 0, 1 + np.floor(share * 65_534 + 0.5)).astype(np.uint16)
    if labels:
        wide = array.astype(np.int64).view(np.uint64)
        with np.errstate(over="ignore"):
            mixed = ((wide ^ (wide >> np.uint64(32))) * np.uint64(0x9E37_79B9_7F4A_7C15)) >> np.uint64(32)
        narrow = array.view(f"u{kind.itemsize}") if kind.itemsize <= 2 else None
        scattered = np.where(wide < 65_536, wide, 1 + mixed % np.uint64(65_535)).astype(np.uint16)
        return narrow if narrow is not None else scattered
    if kind.kind == "i" and kind.itemsize <= 2:
        unsigned = np.dtype(f"u{kind.itemsize}")
        return array.astype(kind.newbyteorder("=")).view(unsigned) ^ unsigned.type(1 << (8 * kind.itemsize - 1))
    low, high = int(array.min()), int(array.max())
    if low >= 0 and high < 65_536:
        return array.astype(np.uint8 if kind.itemsize == 1 else np.uint16)
    assert high - low < 65_535, "no test has others"
    return (array.astype(np.int64) - (low - 1)).astype(np.uint16)


def row_of(array, to):
    """Copies an array of one axis as one of two, of which the first has a length of 1: no chunk changes."""
    def longer(said):
        if isinstance(said, list):
            return [longer(one) for one in said]
        if not isinstance(said, dict):
            return said
        return {key: [1, *value] if key in ("shape", "chunks", "chunk_shape") else longer(value)
                for key, value in said.items()}

    to.mkdir()
    for path in array.rglob("*"):
        name = path.relative_to(array).as_posix()
        if name in (".zarray", "zarr.json"):
            (to / name).write_text(json.dumps(longer(json.loads(path.read_text()))))
        elif name.startswith("c/"):
            (to / "c/0").mkdir(parents=True, exist_ok=True)
            shutil.copy(path, to / "c/0" / path.name)
        elif name.isdecimal():
            shutil.copy(path, to / f"0.{name}")


class Case(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory(prefix="saccade-images-")
        self.addCleanup(folder.cleanup)
        self.work = Path(folder.name)

    def opened(self, image, *options):
        """The levels [c, z, y, x] that Saccade finds in an image."""
        out = self.work / "out.zarr"
        shutil.rmtree(out, ignore_errors=True)
        run = [BIN, "export", image, out, "--compression", "0", *options]
        ran = subprocess.run(run, capture_output=True, text=True)
        self.renamed = "ids such as" in ran.stderr
        if self.renamed:
            self.assertEqual(ran.returncode, 1, "ids that do not fit are not exported unasked")
            shutil.rmtree(out)
            ran = subprocess.run([*run, "--rename-labels"], capture_output=True, text=True)
        self.assertEqual(ran.returncode, 0, f"{image}: {ran.stderr}")
        group = zarr.open_group(out, mode="r", zarr_format=3)
        multiscale = group.attrs["ome"]["multiscales"][0]
        self.transforms = [level["coordinateTransformations"] for level in multiscale["datasets"]]
        return [group[level["path"]][...] for level in multiscale["datasets"]]

    def same(self, image, *levels, options=()):
        """Compares all levels that an export has; those that are compared must be able to differ."""
        got = self.opened(image, *options)
        # Where one chunk holds all, there are no coarser ones.
        needed = next((n + 1 for n, level in enumerate(levels) if max(level.shape[1:]) <= 64), len(levels))
        self.assertEqual(len(got), needed, image)
        for n, (got, want) in enumerate(zip(got, levels)):
            self.assertEqual(got.shape, want.shape, f"{image}, level {n}")
            np.testing.assert_array_equal(got, want, f"{image}, level {n}")
            if want.shape[-1] > 1:
                self.assertTrue((got != np.roll(want, 1, -1)).any(), f"{image}: neighbours are all the same")

    def refused(self, image, *words):
        ran = subprocess.run([BIN, "export", image, self.work / "none.zarr"], capture_output=True, text=True)
        self.assertNotEqual(ran.returncode, 0, f"{image} is opened")
        for word in words:
            self.assertIn(word, ran.stderr, image)


class ByZarrPython(Case):
    """Every axis subset, type and compression that zarr-python has."""

    def written(self, axes, dtype, zarr_format, **how):
        folder = self.work / "image.zarr"
        shutil.rmtree(folder, ignore_errors=True)
        group = group_of(folder, zarr_format, attributes(axes))
        array = values(axes, dtype)
        group.create_array("0", shape=array.shape, dtype=array.dtype, **{"chunks": each(axes, CHUNKS), **how})[...] = array
        return folder, moved_to_czyx(shown(array), axes)

    def check(self, *args, **how):
        with self.subTest(args=args, how=how):
            self.same(*self.written(*args, **how))

    def test_axes(self):
        for n, axes in enumerate(["yx", "xy", "cyx", "zyx", "xyz", "czyx", "zcyx", "tyx", "tzyx", "tczyx", "xyzct", "yxzc"]):
            shards = {"shards": each(axes, SHARDS)} if n % 3 else {}
            self.check(axes, ["u1", "u2"][n % 2], 2 if n % 3 == 0 else 3, **shards)

    def test_types(self):
        for dtype in ["u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f4", "f8"]:
            self.check("zyx", dtype, 3)
            for order in "<>":
                self.check("zyx", f"{order}{dtype}", 2, order="F" if order == ">" else "C")

    def test_compressions_of_version_2(self):
        blosc = [numcodecs.Blosc(cname, 5, shuffle) for cname in ["blosclz", "lz4", "lz4hc", "zlib", "zstd"]
                 for shuffle in [numcodecs.Blosc.NOSHUFFLE, numcodecs.Blosc.SHUFFLE, numcodecs.Blosc.BITSHUFFLE]]
        others = [None, numcodecs.Zstd(3), numcodecs.GZip(5), numcodecs.Zlib(5), numcodecs.LZ4()]
        for n, compressor in enumerate(blosc + others):
            separator = "./"[n % 2]
            self.check("czyx", [">u2", "u1", "<i2"][n % 3], 2, compressors=compressor, order="CF"[n % 2],
                       chunk_key_encoding={"name": "v2", "separator": separator})
        for compressor, word in [(numcodecs.BZ2(), "bz2"), (numcodecs.LZMA(), "lzma")]:
            image, _ = self.written("zyx", "u1", 2, compressors=compressor)
            self.refused(image, word, "known")
        image, _ = self.written("zyx", "u2", 2, filters=[numcodecs.Delta("<u2")])
        self.refused(image, "delta", "known")

    def test_compressions_of_version_3(self):
        big = BytesCodec(endian="big")
        codecs = [
            {"compressors": []}, {"compressors": [GzipCodec(level=5)]}, {"compressors": [ZstdCodec(level=3, checksum=True)]},
            {"compressors": [ZstdCodec(level=1), Crc32cCodec()]}, {"serializer": big, "compressors": [Crc32cCodec()]},
            {"filters": [TransposeCodec(order=(3, 1, 0, 2))], "compressors": [ZstdCodec()]},
            {"filters": [TransposeCodec(order=(2, 3, 1, 0))], "serializer": big, "compressors": [GzipCodec()]},
            {"compressors": [], "chunk_key_encoding": {"name": "v2", "separator": "."}},
            {"compressors": [], "chunk_key_encoding": {"name": "default", "separator": "."}},
        ]
        codecs += [{"compressors": [BloscCodec(cname=cname, shuffle=shuffle)]} for cname in ["blosclz", "lz4", "zlib", "zstd"]
                   for shuffle in ["noshuffle", "shuffle", "bitshuffle"]]
        for n, how in enumerate(codecs):
            shards = {"shards": each("czyx", SHARDS)} if n % 2 else {}
            self.check("czyx", "u2", 3, **how, **shards)
        # The same inside of shards: transposed, big-endian, compressed.
        self.check("czyx", "i2", 3, shards=each("czyx", SHARDS), **codecs[6])

    def test_what_is_not_stored_has_the_fill_value(self):
        for zarr_format, shards in [(2, None), (3, None), (3, each("zyx", SHARDS))]:
            folder = self.work / f"fill{zarr_format}{shards is None}.zarr"
            group = group_of(folder, zarr_format, attributes("zyx"))
            array = group.create_array("0", shape=each("zyx", LENGTHS), dtype="u2", chunks=each("zyx", CHUNKS),
                                       shards=shards, fill_value=700)
            array[:4, :16, 24:48] = values("zyx", "u2")[:4, :16, 24:48]
            self.same(folder, array[...][None])


class Layouts(Case):
    def test_several_levels_are_where_they_are_said_to_be(self):
        array = values("zyx", "u2")
        for n, (half, begin) in enumerate([(array[::2, ::2, ::2], (0, 0, 0)), (array[:3, 5:15, 4:30], (1, -2, 9))]):
            folder = self.work / f"levels{n}.zarr"
            said = attributes("zyx", ("fine", "coarse"))
            # The middle of the first coarse voxel.
            at = [2.0 + 8.0 * by for by in begin]
            said["multiscales"][0]["datasets"][1]["coordinateTransformations"].append(
                {"type": "translation", "translation": at})
            group = group_of(folder, 3, said)
            for name, level in [("fine", array), ("coarse", half)]:
                group.create_array(name, shape=level.shape, dtype=level.dtype, chunks=(2, 16, 16))[...] = level
            want = np.zeros([-(-length // 2) for length in array.shape], "u2")
            own, there = [], []
            for length, size, by in zip(want.shape, half.shape, begin):
                there.append(slice(max(by, 0), min(by + size, length)))
                own.append(slice(max(-by, 0), max(-by, 0) + there[-1].stop - there[-1].start))
            want[tuple(there)] = half[tuple(own)]
            self.same(folder, array[None], want[None])

    def test_plates_and_the_like_are_refused_in_words(self):
        for said, word in [({"plate": {"wells": [{"path": "B/3"}]}}, "B/3/0"), ({"well": {"images": []}}, "WELL/0"),
                           ({"labels": ["cells"]}, "LABELS/NAME: cells"), ({}, "multiscales")]:
            for zarr_format in [2, 3]:
                folder = self.work / f"{len(word)}{zarr_format}.zarr"
                group_of(folder, zarr_format, said)
                self.refused(folder, word)


@unittest.skipUnless(DATA.is_dir(), f"{DATA} is not there")
class Real(Case):
    """Images of real microscopes, and what other programs test themselves with."""

    def levels(self, image, axes, labels=False):
        """All levels, by zarr-python."""
        group = zarr.open_group(image, mode="r")
        said = group.attrs.get("ome", group.attrs)
        paths = [level["path"] for level in said["multiscales"][0]["datasets"]]
        try:
            arrays = [group[path][...] for path in paths]
        except TypeError:
            # Drafts of version 3 called an order F, which zarr-python does not know any more.
            arrays = [tensorstore.open({"driver": "zarr3", "kvstore": f"file://{Path(image).resolve()}/{path}/"}).result()
                      .read().result() for path in paths]
        return [moved_to_czyx(shown(array, labels), axes) for array in arrays]

    def test_blastocyst(self):
        old, new = DATA / "idr0062-6001240-ngff01/6001240.zarr", DATA / "idr0062-6001240-ngff05/6001240_labels_v0.5.zarr"
        self.same(old, *self.levels(old, "tczyx"))
        self.same(new, *self.levels(new, "czyx"))
        labels = new / "labels/0"
        self.same(labels, *self.levels(labels, "czyx", labels=True))

    def test_fly(self):
        for name in ["omezarr04_zyx_u8", "omezarr05_zyx_u8_sharded"]:
            image = DATA / "derived-refwriters/dev" / name
            self.same(image, *self.levels(image, "zyx"))
            self.same(image / "labels/bodies", *self.levels(image / "labels/bodies", "zyx", labels=True))

    def test_precomputed(self):
        folder = DATA / "derived-refwriters/dev"
        for name, labels, end in [("precomputed_gray_raw_unsharded", False, None), ("precomputed_seg_cseg_sharded", True, None),
                                  ("precomputed_pinky40_16nm_cseg_u32_gz", True, (300, 260, 130))]:
            # Tensorstore knows no files that are called .gz.
            plain = self.work / name
            shutil.copytree(folder / name, plain)
            for packed in plain.rglob("*.gz"):
                packed.with_suffix("").write_bytes(gzip.decompress(packed.read_bytes()))
            levels = []
            scales = json.loads((plain / "info").read_text())["scales"]
            for n, scale in enumerate(scales):
                spec = {"driver": "neuroglancer_precomputed", "scale_index": n, "kvstore": f"file://{plain}/"}
                store = tensorstore.open(spec, read=True).result()[tensorstore.d[:].translate_to[0]]
                if end:
                    by = np.array(scale["resolution"]) // scales[0]["resolution"]
                    x, y, z = (int(length) for length in np.array(end) // by)
                    store = store[:x, :y, :z]
                levels.append(moved_to_czyx(shown(store.read().result(), labels), "xyzc"))
            options = ["--region", "0,0,0," + ",".join(map(str, end))] if end else []
            with self.subTest(name):
                self.same(folder / name, *levels, options=options)
                # Where each level lies is kept; the middle of a voxel is half of it further than its corner.
                resolution = np.array(scales[0]["resolution"])
                for scale, transforms in zip(scales, self.transforms):
                    moved = dict((one["type"], one) for one in transforms).get("translation", {}).get("translation", [0] * 4)
                    own = np.array(scale["resolution"])
                    want = np.array(scale.get("voxel_offset", [0] * 3)) * own + (own - resolution) / 2
                    np.testing.assert_allclose(moved[:0:-1], want, err_msg=f"{name}, {scale['key']}")
                self.assertEqual(self.renamed, labels)

    def test_neuroglancer_s_images(self):
        folder = DATA / "neuroglancer-testdata/datasource/zarr/ome_zarr"
        for name in ["simple_0.4", "simple_0.5"]:
            self.same(folder / name, *self.levels(folder / name, "yx"))
        for name in ["basic/identity", "basic/scale", "basic/translation", "basic/sequenceScaleTranslation",
                     "simple/anisotropic_rotation"]:
            image = self.work / f"{name}.zarr"
            shutil.copytree(folder / f"all_0.6/{name}.zarr", image)
            # All have the same chunk, to which there were links.
            (image / "array/c/0/0/0").write_bytes((folder / "all_0.6/base_array/0").read_bytes())
            with self.subTest(name):
                self.same(image, *self.levels(image, "zyx"))
        for name in ["simple/affine", "simple/rotation", "axis_dependent/mapAxis"]:
            self.refused(folder / f"all_0.6/{name}.zarr", "not supported", name.split("/")[1])

    def test_what_is_no_image_is_told(self):
        """Whatever of Neuroglancer's fixtures is a volume, and not compared elsewhere, is refused by name."""
        folder = DATA / "neuroglancer-testdata"
        refused = {
            "datasource/n5/**/attributes.json": "N5, which is not read",
            "datasource/deepzoom/*.dzi": "Deep Zoom image, which is not read",
            "datasource/nifti/*.nii": "NIfTI file, which is not read",
            "datasource/nifti/*.nii.gz": "NIfTI file, which is not read",
            "datasource/zarr/**/*.zip": "zip file, which is not read; unpack it",
            "datasource/zarr/**/manifest.ocdbt": "OCDBT database, which is not read",
            "kvstore/ocdbt/*/manifest.ocdbt": "OCDBT database, which is not read",
            "kvstore/icechunk/*/refs": "Icechunk repository, which is not read",
            "kvstore/icechunk/single_array/zarr.json": "array by itself",
            "kvstore/icechunk/hierarchy/**/zarr.json": "",
            "kvstore/zip/*.zip": "zip file, which is not read; unpack it",
            "codec/npy/*.npy": "are folders; convert it to OME-Zarr",
            "datasource/zarr/zarr_v[23]/*/*.zarr/.z*": "multiscales",
            "datasource/zarr/zarr_v[23]/*/*.zarr/zarr.json": "multiscales",
            "datasource/zarr/zarr_v[23]/*/*.zarr/*/.zarray": "array by itself",
            "datasource/zarr/zarr_v[23]/*/*.zarr/*/zarr.json": "array by itself",
            "datasource/zarr/zarr_v3/examples/*/zarr.json": "array by itself",
        }
        for pattern, word in refused.items():
            found = {path if path.suffix in (".dzi", ".nii", ".gz", ".zip", ".npy") else path.parent
                     for path in folder.glob(pattern)}
            self.assertTrue(found, pattern)
            for path in found:
                with self.subTest(path.relative_to(folder)):
                    self.refused(path, word or "multiscales")

    def test_neuroglancer_s_segmentation(self):
        """Numbers that somebody cut out, written anew as the format says, with no reader in between."""
        raw = DATA / "neuroglancer-testdata/codec/compressed_segmentation/64x64x64-raw-uint64-segmentation.dat"
        bodies = np.fromfile(raw, "<u8").reshape((64, 64, 64, 1), order="F")
        self.assertGreater(len(np.unique(bodies)), 10)
        for sharding in [{}, {"sharding": {"@type": "neuroglancer_uint64_sharded_v1", "preshift_bits": 1, "minishard_bits": 2,
                                           "shard_bits": 1, "hash": "murmurhash3_x86_128", "data_encoding": "gzip",
                                           "minishard_index_encoding": "gzip"}}]:
            folder = self.work / f"bodies{len(sharding)}"
            spec = {
                "driver": "neuroglancer_precomputed", "kvstore": f"file://{folder}/", "create": True,
                "multiscale_metadata": {"type": "segmentation", "data_type": "uint64", "num_channels": 1},
                "scale_metadata": {"resolution": [8, 8, 8], "size": [64, 64, 64], "chunk_size": [32, 16, 24],
                                   "encoding": "compressed_segmentation", "compressed_segmentation_block_size": [8, 8, 4],
                                   **sharding},
            }
            tensorstore.open(spec).result().write(bodies).result()
            with self.subTest(sharded=bool(sharding)):
                self.same(folder, moved_to_czyx(shown(bodies, labels=True), "xyzc"))

    def test_neuroglancer_s_precomputed(self):
        """Of these there are descriptions alone: without voxels they are empty, and with tensorstore's they are those."""
        for name, channels in [("one_channel", 1), ("two_channels", 2)]:
            there = DATA / "neuroglancer-testdata/datasource/precomputed" / name
            self.assertEqual([path.name for path in there.iterdir()], ["info"])
            [empty] = self.opened(there)
            self.assertEqual(empty.shape, (channels, 30, 20, 10))
            self.assertFalse(empty.any())
            info = json.loads((there / "info").read_text())
            scales = info["scales"]
            self.assertEqual(len(scales), 3)
            # What fits into a chunk is exported without coarser levels: each level in turn is the finest.
            for n in range(len(scales)):
                folder = self.work / f"{name}{n}"
                folder.mkdir()
                (folder / "info").write_text(json.dumps({**info, "scales": scales[n:]}))
                spec = {"driver": "neuroglancer_precomputed", "scale_index": 0, "kvstore": f"file://{folder}/"}
                store = tensorstore.open(spec, open=True).result()
                array = np.random.default_rng(n).integers(0, 65_535, store.shape, "u2", endpoint=True)
                store.write(array).result()
                with self.subTest(name, scale=n):
                    self.same(folder, moved_to_czyx(array, "xyzc"))

    def test_neuroglancer_s_arrays(self):
        """Arrays of two and three axes, as levels of images that are made around them."""
        opened = 0
        for folder, zarr_format in [("zarr/zarr_v2/from_zarr-python/data.zarr/[23]d.*", 2),
                                    ("zarr/zarr_v3/from_zarrita/data.zarr/[23]d.*", 3),
                                    ("zarr/zarr_v3/examples/single_res", 3),
                                    ("../kvstore/icechunk/single_array", 3), ("../kvstore/icechunk/hierarchy/a", 3)]:
            arrays = sorted((DATA / "neuroglancer-testdata/datasource").glob(folder))
            self.assertTrue(arrays, folder)
            for array in arrays:
                axes = "zyx" if array.name.startswith("3d") else "yx"
                image = self.work / f"{opened}{array.name}.zarr"
                group_of(image, zarr_format, attributes(axes))
                shutil.copytree(array, image / "0")
                with self.subTest(array.name, zarr_format=zarr_format):
                    if array.name.split(".")[-1] in ("O", "U7", "S7"):
                        self.refused(image, "whole numbers of 8 to 64 bit")
                        continue
                    self.same(image, *self.levels(image, axes))
                    opened += 1
        self.assertGreater(opened, 20)

    def test_neuroglancer_s_arrays_of_one_axis(self):
        """As images they are refused; as the only row of one their numbers are those that zarr-python reads of the axis."""
        opened = 0
        for folder, zarr_format in [("zarr_v2/from_zarr-python", 2), ("zarr_v3/from_zarrita", 3)]:
            arrays = DATA / "neuroglancer-testdata/datasource/zarr" / folder / "data.zarr"
            for array in sorted(arrays.glob("1d.*")):
                with self.subTest(array.name, zarr_format=zarr_format):
                    line, image = (self.work / f"{kind}{zarr_format}{array.name}.zarr" for kind in ["line", "row"])
                    group_of(line, zarr_format, attributes("x"))
                    shutil.copytree(array, line / "0")
                    kind = array.name.split(".")[-2 if array.name.endswith("e") else -1]
                    if kind in ("S7", "U7", "U13", "b1"):
                        self.refused(line, "whole numbers of 8 to 64 bit")
                        continue
                    self.refused(line, "no axes x and y, which images need, but x")
                    group_of(image, zarr_format, attributes("yx"))
                    row_of(array, image / "0")
                    [numbers] = self.levels(image, "yx")
                    np.testing.assert_array_equal(numbers[0, 0, 0], shown(zarr.open_array(array, mode="r")[...]))
                    self.same(image, numbers)
                    opened += 1
        self.assertGreater(opened, 20)


if __name__ == "__main__":
    unittest.main(verbosity=2)

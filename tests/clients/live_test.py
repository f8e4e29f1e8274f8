"""Real clients against a live acquisition."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np
import ome_zarr_models
import tensorstore
import yaozarrs
import zarr

from lib.clients import all_tensorstores, everyone
from lib.reference import Reference
from lib.saccade import BIN, Acquisition, Labels, until

POSITIONS = 60
random = np.random.default_rng(5)


class Live(unittest.TestCase):
    """Tests run in the order of their names: the last one ends the acquisition."""

    @classmethod
    def setUpClass(cls):
        cls.acquisition = Acquisition()
        cls.addClassCleanup(cls.acquisition.close)
        cls.reference = Reference(cls.acquisition)
        cls.url = f"{cls.acquisition.url}/v/{Acquisition.NAME}"
        cls.levels = len(cls.reference.extents)

    def positions(self, level):
        return random.integers(0, self.reference.extents[level], (POSITIONS, 3))

    def compared(self, clients, level):
        """Compares clients at positions that hold still meanwhile: returns those, and their values."""
        for _ in range(30):
            positions = self.positions(level)
            before, values = self.reference.chunks(level, positions)
            read = {name: client(level, positions) for name, client in clients.items()}
            after, _ = self.reference.chunks(level, positions)
            # Chunks whose state did not change in between had these values all the while.
            still = before == after
            for name, got in read.items():
                np.testing.assert_array_equal(got[still], values[still], f"{name}, level {level}")
            if still.mean() >= 0.3:
                return positions[still], values[still]
        self.fail(f"level {level} changes too fast to be compared")

    def test_1_every_client_reads_the_same_voxels_while_they_arrive(self):
        clients = everyone(self.url)
        begun = self.acquisition.revision()
        compared = measured = turned_differs = 0
        while self.acquisition.revision() < begun + 8:
            for level in range(self.levels):
                positions, values = self.compared(clients, level)
                compared += len(positions)
                measured += (values != 0).sum()
                turned = np.minimum(positions[:, ::-1], self.reference.extents[level] - 1)
                turned_differs += (self.reference.values(level, turned) != values).sum()
        self.assertTrue(self.acquisition.microscope.running(), "the acquisition ended before the comparison did")
        self.assertGreater(measured, compared / 4, "most of what was compared was not acquired yet")
        self.assertGreater(turned_differs, compared / 4, "the comparison cannot tell axes apart")
        print(f"\n{compared} positions on {self.levels} levels, {measured} of them acquired, {len(clients)} clients")

    @unittest.skipUnless(os.environ.get("SACCADE_CHROMIUM"), "no browser is named")
    def test_1_neuroglancer_shows_them_while_they_arrive(self):
        from lib.page import Page

        page = Page(os.environ["SACCADE_CHROMIUM"], self.reference.volume["voxel_nm"])
        self.addCleanup(page.close)
        revisions = [self.acquisition.revision()]
        for level in range(self.levels):
            for plane in ["xy", "xz", "yz"]:
                until("tiles arrive", lambda: self.acquisition.revision() > revisions[-1])
                with self.acquisition.held():
                    self.plane_compared(page, level, plane)
                revisions.append(self.acquisition.revision())
        self.assertTrue(self.acquisition.microscope.running(), "the acquisition ended before the comparison did")

    def plane_compared(self, page, level, plane):
        """Compares a plane at a random place, as coarse as a level."""
        downs = [np.array(level["downsampling"]) for level in self.reference.volume["levels"]]
        edges = np.array(self.reference.volume["voxel_nm"]) / min(self.reference.volume["voxel_nm"])
        # Neuroglancer turns the plane of y and z about y: z grows to the left.
        right, down, sign = {"xy": (0, 1, 1), "xz": (0, 2, 1), "yz": (2, 1, -1)}[plane]
        width, height = size = [56, 40]
        scale = downs[level][0]
        for _ in range(60):
            middle = random.uniform(0, self.reference.extents[0])
            points = np.tile(middle, (height, width, 1))
            points[..., right] += sign * (np.arange(width) + 0.5 - width / 2) * scale / edges[right]
            points[..., down] += ((np.arange(height) + 0.5 - height / 2) * scale / edges[down])[:, None]
            points = points.reshape(-1, 3)
            # Not where a fifth of a pixel decides which voxel it is.
            part = np.abs(points / downs[level] - np.round(points / downs[level]))
            clear = (part >= np.minimum(0.2 * scale / edges / downs[level], 0.4)).all(1).reshape(height, width)
            if clear.mean() < 0.2:
                continue
            # Coarse voxels may reach beyond the volume, and are shown there.
            inside = ((points >= 0) & (points < self.reference.extents[0])).all(1).reshape(height, width)
            before = [self.shown(k, points / by) for k, by in enumerate(downs)]
            wants = [want.reshape(height, width) * inside for _, want in before]
            others = [want for k, want in enumerate(wants) if k != level]
            measured = (wants[level] != 0)[clear].sum()
            if measured < 30 or any((wants[level] != other)[clear].sum() < measured / 4 for other in others):
                continue
            version = self.acquisition.json(f"v/{Acquisition.NAME}/volume.json")["version"]
            source = f"{self.url}/at/{version}/zarr/|zarr3:"
            # In OME-Zarr the origin is the middle of voxel 0.
            # On a busy machine a picture may be taken before the new layer is in it: what is wrong stays wrong.
            for _ in range(8):
                got = page.section(source, list(middle - 0.5), size, scale, plane) * inside
                if (wants[level] == got)[clear].all():
                    break
            after = [self.shown(k, points / by)[0] for k, by in enumerate(downs)]
            if any((was[0] != now).any() for was, now in zip(before, after)):
                continue
            place = f"{plane} as coarse as level {level} around {middle}"
            np.testing.assert_array_equal(got[clear], wants[level][clear], place)
            return
        self.fail(f"{plane} as coarse as level {level}: no place has tiles and holds still")

    def shown(self, level, points):
        """States and values at points [voxels of the level]; outside of the volume there is nothing."""
        at = np.floor(points).astype(int)
        inside = ((at >= 0) & (at < self.reference.extents[level])).all(1)
        states, values = np.full(len(at), "outside", object), np.zeros(len(at), np.uint8)
        states[inside], values[inside] = self.reference.chunks(level, at[inside])
        return states, values

    def test_2_the_example_runs(self):
        example = Path(__file__).parents[2] / "examples" / "live_volume.py"
        run = subprocess.run([sys.executable, example, self.acquisition.url], capture_output=True, text=True, timeout=60)
        self.assertEqual(run.returncode, 0, run.stderr)
        self.assertRegex(run.stdout, r"tissue: 301 x 203 x 70 voxels of 8.0 x 8.0 x 40.0 nm, \d+ tiles")
        self.assertRegex(run.stdout, r"acquired: \d+%")
        self.assertRegex(run.stdout, r"revision \d+: tile at")

    def test_2_metadata_is_what_the_specifications_say(self):
        yaozarrs.validate_zarr_store(f"{self.url}/zarr")
        for version, folder, zarr_format in [("0.5", "zarr", 3), ("0.4", "zarr2", 2)]:
            group = zarr.open_group(f"{self.url}/{folder}", mode="r", zarr_format=zarr_format)
            image = ome_zarr_models.open_ome_zarr(group, version=version)
            self.assertEqual(type(image).__name__, "Image")
            self.assertEqual(image.ome_zarr_version, version)

    def test_2_metadata_that_is_wrong_is_refused(self):
        right = self.acquisition.get(f"v/{Acquisition.NAME}/zarr/zarr.json").decode()
        image = json.loads(right)["attributes"]["ome"]["multiscales"][0]
        yaozarrs.validate_ome_json(json.dumps({"version": "0.5", "multiscales": [image]}))
        wrong = [
            {**image, "axes": image["axes"][::-1]},
            {**image, "datasets": [{"path": "0", "coordinateTransformations": []}]},
        ]
        for image in wrong:
            with self.assertRaises(ValueError):
                yaozarrs.validate_ome_json(json.dumps({"version": "0.5", "multiscales": [image]}))

    def test_3_a_tile_that_moves_is_seen_without_opening_again(self):
        self.acquisition.end()
        rechecking = all_tensorstores(self.url, recheck_cached_data=True)
        trusting = all_tensorstores(self.url, recheck_cached_data=False)
        tile = next(record for record in self.acquisition.written() if record["record"] == "tile")
        a, b, c, d, x, y = tile["transform"]
        corner = np.array([round(x), round(y), tile["section"]])
        size = np.array([*tile["size"], 1])
        around = corner + np.clip(random.integers(0, size, (POSITIONS, 3)), 0, None)
        around = np.clip(around, 0, self.reference.extents[0] - 1)
        old = self.reference.values(0, around)
        for name, client in {**rechecking, **trusting}.items():
            np.testing.assert_array_equal(client(0, around), old, name)

        moved = [a, b, c, d, x + 9, y + 7]
        self.acquisition.append({"record": "transform", "tile": tile["tile"], "transform": moved})
        new = self.reference.values(0, around)
        self.assertGreater((new != old).sum(), POSITIONS / 2, "the tile did not move")
        for name, client in rechecking.items():
            np.testing.assert_array_equal(client(0, around), new, name)
        for name, client in trusting.items():
            self.assertTrue((client(0, around) == old).all(), f"{name} never cached: the comparison shows nothing")

    def test_3_an_exported_part_is_the_part(self):
        folder = Path(tempfile.mkdtemp(prefix="saccade-export-"))
        self.addCleanup(shutil.rmtree, folder)
        out = folder / "part.zarr"
        low, high = np.array([37, 21, 5]), np.array([250, 190, 61])
        region = ",".join(map(str, [*low, *high]))
        run = [BIN, "export", self.acquisition.url, out, "--region", region]
        ran = subprocess.run(run, capture_output=True, text=True, timeout=120)
        self.assertEqual(ran.returncode, 0, ran.stderr)
        self.assertRegex(ran.stderr, r"exported \d+\.\d MB in \d+ s: \d+ shards")
        yaozarrs.validate_zarr_store(str(out))
        group = zarr.open_group(out, mode="r", zarr_format=3)
        image = ome_zarr_models.open_ome_zarr(group, version="0.5")
        datasets = group.attrs["ome"]["multiscales"][0]["datasets"]
        self.assertEqual(type(image).__name__, "Image")
        voxel = np.array(self.reference.volume["voxel_nm"])
        for level, dataset in enumerate(datasets):
            down = np.array(self.reference.volume["levels"][level]["downsampling"])
            first = np.floor(low / down).astype(int)
            end = np.minimum(np.ceil(high / down).astype(int), self.reference.extents[level])
            spec = {"driver": "zarr3", "kvstore": f"file://{out}/{level}/"}
            for name, array in [("zarr", group[str(level)]), ("tensorstore", tensorstore.open(spec).result())]:
                self.assertEqual(list(array.shape), [1, *(end - first)[::-1]], name)
                values = np.asarray(array[0])
                at = random.integers(0, end - first, (400, 3))
                want = self.reference.values(level, at + first)
                np.testing.assert_array_equal(values[tuple(at[:, ::-1].T)], want, f"{name}, level {level}")
                self.assertGreater((want != 0).mean(), 0.3)
            transforms = dataset["coordinateTransformations"]
            scale, moved = transforms[0]["scale"][:0:-1], transforms[1]["translation"][:0:-1]
            np.testing.assert_allclose(scale, voxel * down)
            np.testing.assert_allclose(moved, (first + 0.5) * down * voxel - voxel / 2)
        again = subprocess.run(run, capture_output=True, text=True, timeout=60)
        if "the volume is at" in again.stderr:
            self.assertEqual(again.returncode, 1, "tiles came meanwhile")
        else:
            self.assertEqual((again.returncode, "nothing to do" in again.stderr), (0, True), again.stderr)
        other = subprocess.run([*run, "--compression", "0"], capture_output=True, text=True, timeout=60)
        self.assertEqual(other.returncode, 1)
        self.assertIn("there is something already", other.stderr)

    def test_3_labels_are_said_to_be_labels_and_stay_labels(self):
        with Labels() as labels:
            for version, folder, zarr_format in [("0.5", "zarr", 3), ("0.4", "zarr2", 2)]:
                group = zarr.open_group(f"{labels.url}/{folder}", mode="r", zarr_format=zarr_format)
                image = ome_zarr_models.open_ome_zarr(group, version=version)
                self.assertEqual((type(image).__name__, image.ome_zarr_version), ("ImageLabel", version))
                image = yaozarrs.validate_ome_json(json.dumps(labels.ome(folder)))
                self.assertEqual(type(image).__name__, "LabelImage")
            yaozarrs.validate_zarr_store(f"{labels.url}/zarr")
            info = json.loads(labels.get("precomputed/info"))
            self.assertEqual((info["type"], info["data_type"]), ("segmentation", "uint16"))
            for level, scale in enumerate(info["scales"]):
                x, y, z = scale["size"]
                at = np.stack(np.meshgrid(np.arange(x), np.arange(y), np.arange(z), indexing="ij"), -1).reshape(-1, 3)
                read = {name: client(level, at) for name, client in everyone(labels.url).items()}
                first, *others = read.values()
                for other in others:
                    np.testing.assert_array_equal(other, first)
                self.assertLessEqual(set(np.unique(first)), {0, *Labels.NUMBERS}, f"level {level}")
                self.assertGreater(len(np.unique(first)), 2, f"level {level}")

    @unittest.skipUnless(os.environ.get("SACCADE_CHROMIUM"), "no browser is named")
    def test_4_neuroglancer_shows_the_voxels(self):
        from lib.page import Page

        section = self.acquisition.written()[0]["section"]
        page = Page(os.environ["SACCADE_CHROMIUM"], self.reference.volume["voxel_nm"])
        self.addCleanup(page.close)
        shown = {}
        for level in [0, 1]:
            down = np.array(self.reference.volume["levels"][level]["downsampling"])
            self.assertEqual(list(down), [[1, 1, 1], [2, 2, 1]][level])
            width, height = size = [140, 96]
            x, y = np.meshgrid(np.arange(width) + 3, np.arange(height) + 2)
            at = np.stack([x, y, np.full_like(x, section)], -1).reshape(-1, 3)
            want = self.reference.values(level, at).reshape(height, width)
            self.assertGreater((want != 0).mean(), 0.3)
            # The corner of the picture is a corner of voxels.
            middle = np.array([3 + width / 2, 2 + height / 2, section + 0.5]) * down
            for source, origin in [
                (f"{self.url}/zarr/|zarr3:", 0.5),
                (f"{self.url}/zarr2/|zarr2:", 0.5),
                (f"{self.url}/precomputed/|neuroglancer-precomputed:", 0),
            ]:
                # In OME-Zarr the origin is the middle of voxel 0, in precomputed its corner. Pixels
                # moved by less than half a voxel show the same voxels, if these are where they belong.
                for moved in [0.3, -0.3]:
                    at = middle - origin + np.array([moved, moved, 0]) * down
                    got = page.section(source, list(at), size, down[0])
                    np.testing.assert_array_equal(got, want, f"{source}, level {level}, moved by {moved}")
            shown[level] = want
        off = page.section(source, list(middle - origin + np.array([0.7, 0.7, 0]) * down), size, down[0])
        self.assertGreater((off != want).mean(), 0.3, "the comparison cannot tell voxels from their neighbours")
        self.assertGreater((shown[0] != shown[1]).mean(), 0.3, "the comparison cannot tell levels apart")


if __name__ == "__main__":
    unittest.main(verbosity=2)

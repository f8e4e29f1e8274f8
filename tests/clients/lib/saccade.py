"""The command line, as a user runs it, and a live acquisition made with it."""

import contextlib
import json
import os
import re
import signal
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np
from PIL import Image

BIN = os.environ.get("SACCADE_BIN")
if not BIN:
    raise SystemExit("SACCADE_BIN must name the saccade binary; ./dev test sets it")


def until(what, condition, seconds=60):
    """Polls until `condition` returns something true, and returns it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if last := condition():
            return last
        time.sleep(0.05)
    raise TimeoutError(f"after {seconds} s still waiting: {what}")


class Process:
    """A running `saccade`; what it prints goes to a file."""

    def __init__(self, log, *args):
        self.log = Path(log)
        self.args = args
        with self.log.open("wb") as out:
            self.child = subprocess.Popen([BIN, *map(str, args)], stdin=subprocess.DEVNULL, stdout=out, stderr=out)

    def running(self):
        return self.child.poll() is None

    def printed(self, pattern):
        def look():
            match = re.search(pattern, self.log.read_text(errors="replace"))
            if not match and not self.running():
                raise RuntimeError(f"saccade {self.args} ended:\n{self.log.read_text(errors='replace')}")
            return match

        return until(f"saccade {self.args[0]} prints {pattern}", look)[0]

    def stop(self):
        if self.running():
            self.child.send_signal(signal.SIGTERM)
        try:
            self.child.wait(20)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()


class Acquisition:
    """A microscope, an ingest and a server; odd sizes, several chunks along every axis."""

    NAME = "tissue"

    def __init__(self):
        self.folder = tempfile.TemporaryDirectory(prefix="saccade-clients-")
        work = Path(self.folder.name)
        self.records = work / "acquisition" / "tiles.jsonl"
        archive = work / "archive"
        self.processes = []
        try:
            self._simulate("max")
            until("tiles are written", lambda: self.records.exists() and len(self.written()) >= 150)
            # A third at once, the rest at two or three tiles a second.
            self.microscope.stop()
            self._simulate("0.04")
            self._start("ingest", self.records.parent, archive)
            until("the catalog is there", (archive / "catalog.sqlite").exists)
            self.url = self._start("serve", archive, "--port", "0").printed(r"http://[\w.:]+")
            until("tiles arrive", lambda: self.revision() >= 150)
        except BaseException:
            self.close()
            raise

    def _simulate(self, rate):
        self.microscope = self._start(
            "simulate", self.records.parent, "--phantom", "--name", self.NAME, "--extent", "301,203,70",
            "--voxel-nm", "8,8,40", "--tile", "128x128", "--rate", rate, "--shuffle", "--corrections", "never",
            "--seed", "11")

    def written(self):
        """The microscope's records."""
        return [json.loads(line) for line in self.records.read_text().split("\n")[:-1]]

    def _start(self, *args):
        process = Process(Path(self.folder.name) / f"{args[0]}.log", *args)
        self.processes.append(process)
        return process

    def get(self, path):
        with urllib.request.urlopen(f"{self.url}/{path}", timeout=20) as answer:
            return answer.read()

    def json(self, path):
        return json.loads(self.get(path))

    def revision(self):
        """Of the volume; 0 before it is offered."""
        volumes = self.json("volumes.json")["volumes"]
        return volumes[0]["revision"] if volumes else 0

    @contextlib.contextmanager
    def held(self):
        """Holds the microscope for a moment: coarse chunks change with every tile, faster than a browser draws."""
        self.microscope.child.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self.microscope.child.send_signal(signal.SIGCONT)

    def end(self):
        """Stops the microscope and waits until everything it wrote is taken in."""
        self.microscope.stop()
        until("all records are taken in", lambda: self.revision() >= len(self.written()))

    def append(self, record):
        """Adds a record as the microscope would, and waits until it is taken in."""
        before = self.revision()
        with self.records.open("a") as file:
            file.write(json.dumps(record) + "\n")
        until("the record is taken in", lambda: self.revision() > before)

    def close(self):
        for process in reversed(self.processes):
            process.stop()
        self.folder.cleanup()


class Labels:
    """Tiles of labels of 16 bits that overlap and are turned, behind a server."""

    NUMBERS = [7, 300, 41_000, 65_535]

    def __init__(self):
        self.folder = tempfile.TemporaryDirectory(prefix="saccade-labels-")
        work = Path(self.folder.name)
        scope, archive = work / "scope", work / "archive"
        scope.mkdir()
        volume = {"name": "cells", "extent": [240, 170, 3], "voxel_nm": [4, 4, 40], "dtype": "uint16", "kind": "labels"}
        (scope / "volume.json").write_text(json.dumps(volume))
        random = np.random.default_rng(3)
        with (scope / "tiles.jsonl").open("w") as records:
            for n, (x, y, turn) in enumerate([(-5, 3, 0.02), (95, -8, -0.03), (20.5, 60, 0.3)]):
                cells = random.choice([0, *self.NUMBERS], (18, 20)).astype(np.uint16)
                pixels = np.kron(cells, np.ones((9, 8), np.uint16))
                Image.fromarray(pixels).save(scope / f"{n}.png")
                cos, sin = np.cos(turn), np.sin(turn)
                size = [pixels.shape[1], pixels.shape[0]]
                record = {"record": "tile", "tile": str(n), "file": f"{n}.png", "section": n // 2, "size": size,
                          "transform": [cos, sin, -sin, cos, x, y]}
                records.write(json.dumps(record) + "\n")
        subprocess.run([BIN, "ingest", scope, archive, "--once"], check=True, capture_output=True)
        self.server = Process(work / "serve.log", "serve", archive, "--port", "0")
        self.url = self.server.printed(r"http://[\w.:]+") + "/v/cells"

    def get(self, path):
        with urllib.request.urlopen(f"{self.url}/{path}", timeout=20) as answer:
            return answer.read()

    def ome(self, folder):
        """The image's metadata, as its version has them."""
        if folder == "zarr":
            return json.loads(self.get("zarr/zarr.json"))["attributes"]["ome"]
        return json.loads(self.get("zarr2/.zattrs"))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.stop()
        self.folder.cleanup()

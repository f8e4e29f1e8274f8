"""What tests of an archive in an object store begin with, and what holds for every one."""

import os
import random
import sqlite3
import subprocess
import sys
import tempfile
import time
import unittest
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "clients"))
from lib.saccade import BIN, Process  # noqa: E402
from store import BUCKET, Proxy, Store  # noqa: E402

SEED = int(os.environ.get("SACCADE_S3_SEED", time.time_ns() % 1_000_000))


def run(*args, **env):
    return subprocess.run([BIN, *map(str, args)], capture_output=True, text=True, timeout=120, env={**os.environ, **env})


class ArchiveTest(unittest.TestCase):
    """One acquisition, its archive in a folder, and an empty archive in the store for each test."""

    @classmethod
    def acquire(cls):
        """Makes the acquisition."""
        raise NotImplementedError

    @classmethod
    def setUpClass(cls):
        print(f"seed {SEED}: SACCADE_S3_SEED={SEED} repeats the faults", flush=True)
        random.seed(SEED)
        folder = tempfile.TemporaryDirectory(prefix="saccade-s3-")
        cls.addClassCleanup(folder.cleanup)
        cls.work = Path(folder.name)
        cls.store = Store()
        cls.addClassCleanup(cls.store.close)
        for name in [name for name in os.environ if name.startswith("AWS_")]:
            del os.environ[name]
        os.environ.update(AWS_ACCESS_KEY_ID="id", AWS_SECRET_ACCESS_KEY="secret", AWS_EC2_METADATA_DISABLED="true")
        cls.acquisition = cls.work / "acquisition"
        cls.acquire()
        cls.local = cls.work / "local"
        made = run("ingest", cls.acquisition, cls.local, "--once")
        assert made.returncode == 0, made.stderr
        cls.want = {str(path.relative_to(cls.local)): path.read_bytes() for path in cls.local.glob("tiles/**/*.tif")}

    def setUp(self):
        self.proxy = Proxy(self.store, SEED)
        self.addCleanup(self.proxy.close)
        os.environ["AWS_ENDPOINT_URL"] = self.proxy.url
        self.name_archive(self._testMethodName)

    def start(self, *args):
        process = Process(self.work / f"{self.prefix}-{args[0]}.log", *args)
        self.addCleanup(process.stop)
        return process

    def name_archive(self, prefix):
        """Has what follows be of an archive of that name."""
        self.prefix = prefix
        self.catalog = self.work / f"{prefix}.sqlite"
        self.archive = [f"s3://{BUCKET}/{prefix}", "--catalog", self.catalog]

    def named(self):
        """What the catalog names."""
        if not self.catalog.exists():
            return []
        with sqlite3.connect(self.catalog) as catalog:
            if not catalog.execute("SELECT 1 FROM sqlite_schema WHERE name = 'tiles'").fetchone():
                return []
            return [name for (name,) in catalog.execute("SELECT pyramid FROM tiles")]

    def whole(self):
        """Checks what the catalog names; returns how many there are."""
        named = self.named()
        for name in named:
            self.assertEqual(self.store.object(self.prefix, name), self.want[name], name)
        return len(named)

    def complete(self):
        self.assertEqual(sorted(self.named()), sorted(self.want))
        self.whole()
        names = self.store.names(self.prefix)
        self.assertEqual(names.count("identity"), 1, "the mark by which catalog and pyramids know each other")
        names.remove("identity")
        self.assertEqual(sorted(names), sorted(self.want), "objects that nobody names")

    def checked(self):
        done = run("check", *self.archive)
        return done.returncode, done.stdout + done.stderr

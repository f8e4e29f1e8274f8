"""Look at a volume while it is being acquired, with zarr and tensorstore.

    pip install zarr fsspec aiohttp tensorstore
    python live_volume.py http://localhost:8080

Every cell (`# %%`) can be run by itself in an editor that knows them, or be pasted into a notebook.
"""

# %% Which volumes are there, and what is in them?
import json
import sys
import time
import urllib.request
from urllib.parse import quote

import numpy as np
import tensorstore
import zarr

server = (sys.argv[1] if len(sys.argv) > 1 else "http://localhost:8080").rstrip("/")


def get(path):
    with urllib.request.urlopen(f"{server}/{path}") as answer:
        return json.load(answer)


name = get("volumes.json")["volumes"][0]["name"]
path = f"v/{quote(name, safe='')}"
described = get(f"{path}/volume.json")
volume = described["volume"]
status = get(f"{path}/status.json")
print(f"{name}: {' x '.join(map(str, volume['levels'][0]['extent']))} voxels of "
      f"{' x '.join(map(str, volume['voxel_nm']))} nm, {status['tiles']} tiles in {status['sections']} sections")

# %% A coarse level, whole: how much of it is there?
group = zarr.open_group(f"{server}/{path}/zarr", mode="r")
datasets = group.attrs["ome"]["multiscales"][0]["datasets"]
coarse = group[datasets[-1]["path"]][0]  # channel 0; z, y, x; 0 is "not acquired"
print(f"acquired: {(coarse != 0).mean():.0%} of the volume, seen from afar")

# %% A fine region, which tensorstore fetches again only where it changed
fine = tensorstore.open({
    "driver": "neuroglancer_precomputed",
    "kvstore": f"{server}/{path}/precomputed/",
    "scale_index": 0,
    "recheck_cached_data": True,
}, context=tensorstore.Context({"cache_pool": {"total_bytes_limit": 1 << 28}}), read=True).result()
x, y, z, _ = fine.shape
region = fine[x // 2 - 50:x // 2 + 50, y // 2 - 50:y // 2 + 50, :, 0]
before = region.read().result()
print(f"the middle: {region.shape} voxels, {(before != 0).mean():.0%} acquired, mean {before[before != 0].mean():.1f}"
      if before.any() else "the middle: nothing yet")

# %% Wait for the next change, and look again
request = urllib.request.Request(f"{server}/{path}/events", headers={"Last-Event-ID": str(described["revision"])})
change, until = None, time.monotonic() + 60
with urllib.request.urlopen(request, timeout=60) as events:
    for line in events:  # one that says nothing now and then, too, as long as there is no change
        if line.startswith(b"data:"):
            change = json.loads(line[5:])
        if change or time.monotonic() > until:
            break
after = region.read().result()
if change:
    print(f"revision {change['revision']}: {change['reason']} at {change['voxels']['min']}; "
          f"{np.count_nonzero(after != before)} voxels of the middle differ")
else:
    print("nothing has changed for a minute")

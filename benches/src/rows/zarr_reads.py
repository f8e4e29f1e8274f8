"""Random reads of a sharded OME-Zarr by tensorstore.

`write FOLDER EDGE SHARD CHUNK [checked]` writes the image, `checked` with a checksum of each chunk. `read FOLDER X,Y,Z...` reads a
cube of 64 voxels at each position, all of them asked for at once, and prints JSON: version, seconds, and the sum of all voxels.
"""

import json
import pathlib
import sys
import time

import numpy
import tensorstore

CUBE = 64


def write(folder, edge, shard, chunk, checked):
    codecs = [{"name": "bytes"}, {"name": "zstd", "configuration": {"level": 3}}] + [{"name": "crc32c"}] * checked
    sharding = {"name": "sharding_indexed", "configuration": {
        "chunk_shape": [chunk] * 3, "codecs": codecs,
        "index_codecs": [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "crc32c"}]}}
    store = tensorstore.open({
        "driver": "zarr3", "kvstore": f"file://{folder}/0/", "create": True, "delete_existing": True,
        "metadata": {"shape": [edge] * 3, "data_type": "uint8", "codecs": [sharding],
                     "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [shard] * 3}}}}).result()
    random = numpy.random.default_rng(1)
    at = numpy.arange(edge)
    plane = numpy.sin(at[:, None] / 9.0) + numpy.sin(at[None, :] / 11.0)
    for z in range(0, edge, shard):
        slab = [110 + 25 * (plane + numpy.sin((z + n) / 7.0)) + random.normal(0, 6, plane.shape) for n in range(shard)]
        store[z : z + shard].write(numpy.clip(slab, 1, 255).astype(numpy.uint8)).result()
    scale = [{"type": "scale", "scale": [1, 1, 1]}]
    axes = [{"name": name, "type": "space", "unit": "nanometer"} for name in "zyx"]
    ome = {"version": "0.5", "multiscales": [
        {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": scale}]}]}
    group = {"zarr_format": 3, "node_type": "group", "attributes": {"ome": ome}}
    pathlib.Path(folder, "zarr.json").write_text(json.dumps(group))


def read(folder, positions):
    # What was read once is kept, as in ours: indices of shards above all.
    context = tensorstore.Context({"cache_pool": {"total_bytes_limit": 512 << 20}})
    start = time.perf_counter()
    store = tensorstore.open({"driver": "zarr3", "kvstore": f"file://{folder}/0/"}, context=context, read=True).result()
    reads = [store[z : z + CUBE, y : y + CUBE, x : x + CUBE].read() for x, y, z in positions]
    cubes = [cube.result() for cube in reads]
    seconds = time.perf_counter() - start
    total = sum(int(cube.sum(dtype=numpy.uint64)) for cube in cubes)
    print(json.dumps({"version": tensorstore.__version__ if hasattr(tensorstore, "__version__") else "",
                      "seconds": seconds, "sum": total}))


if sys.argv[1] == "write":
    write(sys.argv[2], *map(int, sys.argv[3:6]), checked=sys.argv[6:] == ["checked"])
else:
    read(sys.argv[2], [tuple(map(int, text.split(","))) for text in sys.argv[3:]])

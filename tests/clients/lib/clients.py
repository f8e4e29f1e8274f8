"""The programs that are judged: each reads voxels of a level at positions x, y, z."""

import numpy as np
import tensorstore
import zarr


def zarr_python(url, folder, zarr_format):
    """zarr-python, by the path that the multiscale's metadata names."""
    group = zarr.open_group(f"{url}/{folder}", mode="r", zarr_format=zarr_format)
    attributes = group.attrs["ome"] if zarr_format == 3 else group.attrs
    paths = [dataset["path"] for dataset in attributes["multiscales"][0]["datasets"]]

    def read(level, positions):
        x, y, z = positions.T
        return group[paths[level]].vindex[np.zeros_like(x), z, y, x]

    return read


def tensorstore_zarr(url, folder, driver, **options):
    def read(level, positions):
        x, y, z = positions.T
        store = opened(level)
        return store.vindex[np.zeros_like(x), z, y, x].read().result()

    opened = _opened(lambda level: {"driver": driver, "kvstore": f"{url}/{folder}/{level}/", **options})
    return read


def tensorstore_precomputed(url, **options):
    def read(level, positions):
        x, y, z = positions.T
        store = opened(level)
        return store.vindex[x, y, z, np.zeros_like(x)].read().result()

    opened = _opened(lambda level: {
        "driver": "neuroglancer_precomputed", "kvstore": f"{url}/precomputed/", "scale_index": level, **options})
    return read


def _opened(spec):
    """Each level once: what is open stays open."""
    stores = {}
    context = tensorstore.Context({"cache_pool": {"total_bytes_limit": 200_000_000}})

    def open_level(level):
        if level not in stores:
            stores[level] = tensorstore.open(spec(level), context=context, read=True).result()
        return stores[level]

    return open_level


def all_tensorstores(url, **options):
    return {
        "tensorstore zarr3": tensorstore_zarr(url, "zarr", "zarr3", **options),
        "tensorstore zarr2": tensorstore_zarr(url, "zarr2", "zarr", **options),
        "tensorstore precomputed": tensorstore_precomputed(url, **options),
    }


def everyone(url):
    """All clients, none of which may trust what it fetched before."""
    return {
        "zarr-python 0.5": zarr_python(url, "zarr", 3),
        "zarr-python 0.4": zarr_python(url, "zarr2", 2),
        **all_tensorstores(url, recheck_cached_data=True),
    }

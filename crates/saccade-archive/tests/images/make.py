"""Writes the images beside it with other people's programs: tifffile, Pillow and libtiff's tiffcp.

    pip install tifffile imagecodecs pillow numpy; apt install libtiff-tools
    python make.py

Every image shows the same texture, which the test computes anew: see `texture` there.
"""

import subprocess
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

HERE = Path(__file__).parent
WIDTH, HEIGHT = 53, 37

y, x = np.mgrid[:HEIGHT, :WIDTH]
DEEP = ((x * 977 + y * 613 + (x * y) % 89 * 301) % 65521).astype(np.uint16)
FLAT = (DEEP >> 8).astype(np.uint8)
BITS = (DEEP >> 15).astype(np.uint8)


def tiff(name, image, **options):
    options.setdefault("photometric", "minisblack")
    tifffile.imwrite(HERE / f"{name}.tif", image, metadata=None, software=False, **options)


def copy(name, of, *options):
    subprocess.run(["tiffcp", *options, HERE / f"{of}.tif", HERE / f"{name}.tif"], check=True)


for bits, image in (("8", FLAT), ("16", DEEP)):
    tiff(f"striped-{bits}", image, rowsperstrip=5)
    tiff(f"one-strip-{bits}", image)
    tiff(f"tiled-{bits}", image, tile=(16, 32))
    tiff(f"big-{bits}", image, bigtiff=True, tile=(16, 16))
    tiff(f"big-endian-{bits}", image, byteorder=">", rowsperstrip=7)
    tiff(f"big-big-endian-{bits}", image, byteorder=">", bigtiff=True, rowsperstrip=7)
    for name, compression in (("lzw", "lzw"), ("deflate", "zlib"), ("packbits", "packbits")):
        tiff(f"{name}-{bits}", image, compression=compression, rowsperstrip=9)
        if compression != "packbits":
            tiff(f"{name}-differences-{bits}", image, compression=compression, predictor=2, rowsperstrip=9)
            tiff(f"{name}-tiled-{bits}", image, compression=compression, predictor=2, tile=(16, 16))
    copy(f"libtiff-lzw-tiled-{bits}", f"striped-{bits}", "-c", "lzw:2", "-t", "-w", "16", "-l", "16")
    copy(f"libtiff-big-endian-deflate-{bits}", f"striped-{bits}", "-B", "-c", "zip:2", "-r", "4")
    copy(f"libtiff-big-packbits-{bits}", f"striped-{bits}", "-8", "-c", "packbits", "-r", "4")
    tiff(f"white-is-zero-{bits}", image.max() * 0 + np.iinfo(image.dtype).max - image, photometric="miniswhite")
    # Only the first page of several is the tile.
    tiff(f"pages-{bits}", np.stack([image, image // 2, image // 3]), rowsperstrip=9)
    Image.fromarray(image).save(HERE / f"pillow-{bits}.png")

Image.fromarray(FLAT).save(HERE / "pillow-lzw-8.tif", compression="tiff_lzw")
Image.fromarray(np.stack([FLAT] * 3, -1)).save(HERE / "rgb-8.png")
Image.fromarray(FLAT).quantize(256, dither=Image.Dither.NONE).save(HERE / "palette-8.png")
Image.fromarray(BITS * 255).convert("1", dither=Image.Dither.NONE).save(HERE / "bits-1.png")
Image.fromarray(BITS * 255).convert("1", dither=Image.Dither.NONE).save(HERE / "bits-1.tif")
# Lossy: smooth enough to come back within a few shades.
SMOOTH = (x * 3 + y * 2).astype(np.uint8)
Image.fromarray(SMOOTH).save(HERE / "smooth-8.jpg", quality=95)
Image.fromarray(SMOOTH).save(HERE / "smooth-progressive-8.jpg", quality=95, progressive=True)
tiff("smooth-jpeg-8", SMOOTH, compression="jpeg", compressionargs={"level": 95}, tile=(16, 16))

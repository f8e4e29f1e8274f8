"""Processor time of OpenCV's warpAffine, one thread, and how far pictures are from exact ones.

Prints JSON: version, seconds per picture, greatest difference of our pictures and of OpenCV's.
"""

import json
import pathlib
import sys
import time

import cv2
import numpy

cv2.setNumThreads(1)
image_edge, picture_edge = int(sys.argv[1]), int(sys.argv[2])
folder = pathlib.Path(sys.argv[3])
image = numpy.fromfile(folder / "image", numpy.uint8).reshape(image_edge, image_edge)
picture = numpy.empty((picture_edge, picture_edge), numpy.uint8)
flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


def exact(image_from_picture):
    """Bilinear interpolation in double precision, not rounded."""
    y, x = numpy.mgrid[:picture_edge, :picture_edge].astype(numpy.float64)
    (a, b, c), (d, e, f) = image_from_picture
    u, v = a * x + b * y + c, d * x + e * y + f
    left, top = numpy.floor(u).astype(int), numpy.floor(v).astype(int)
    s, t = u - left, v - top
    at = lambda down, right: image[top + down, left + right].astype(numpy.float64)
    upper = at(0, 0) * (1 - s) + at(0, 1) * s
    lower = at(1, 0) * (1 - s) + at(1, 1) * s
    return upper * (1 - t) + lower * t


seconds, off, their_off = [], [], []
for n, text in enumerate(sys.argv[4:]):
    image_from_picture = numpy.array([float(v) for v in text.split()]).reshape(2, 3)
    pictures, took, start = 0, 0.0, time.process_time()
    while took < 0.3:
        cv2.warpAffine(image, image_from_picture, picture.shape, dst=picture, flags=flags)
        pictures += 1
        took = time.process_time() - start
    seconds.append(took / pictures)
    ours = numpy.fromfile(folder / str(n), numpy.uint8).reshape(picture.shape)
    should_be = exact(image_from_picture)
    off.append(float(numpy.abs(ours - should_be).max()))
    their_off.append(float(numpy.abs(picture - should_be).max()))
print(json.dumps({"version": cv2.__version__, "seconds": seconds, "off": off, "their_off": their_off}))

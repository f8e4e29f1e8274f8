"""Processor time of OpenCV's warpAffine, one thread. Prints JSON: version, seconds per picture."""

import json
import sys
import time

import cv2
import numpy

cv2.setNumThreads(1)
image_edge, picture_edge = int(sys.argv[1]), int(sys.argv[2])
image = numpy.random.default_rng(1).integers(1, 256, (image_edge, image_edge), numpy.uint8)
picture = numpy.empty((picture_edge, picture_edge), numpy.uint8)
flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
seconds = []
for text in sys.argv[3:]:
    image_from_picture = numpy.array([float(v) for v in text.split()]).reshape(2, 3)
    pictures, took, start = 0, 0.0, time.process_time()
    while took < 0.3:
        cv2.warpAffine(image, image_from_picture, picture.shape, dst=picture, flags=flags)
        pictures += 1
        took = time.process_time() - start
    seconds.append(took / pictures)
print(json.dumps({"version": cv2.__version__, "seconds": seconds}))

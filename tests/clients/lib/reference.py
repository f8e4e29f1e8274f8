"""Voxels by plain HTTP and arithmetic: no code in common with the clients that are judged.

Positions are columns x, y, z of an integer array.
"""

import http.client
from urllib.parse import urlsplit

import numpy as np


class Reference:
    """The server's own chunks of one volume."""

    def __init__(self, acquisition):
        self.volume = acquisition.json(f"v/{acquisition.NAME}/volume.json")["volume"]
        self.path = f"/v/{acquisition.NAME}/zarr"
        self.connection = http.client.HTTPConnection(urlsplit(acquisition.url).netloc, timeout=20)
        self.chunk = np.array(self.volume["chunk"])
        self.extents = [np.array(level["extent"]) for level in self.volume["levels"]]

    def chunks(self, level, positions):
        """Of each position: its chunk's state (the tag, or 404) and its value."""
        held = {}
        states, values = [], []
        for position in positions:
            at = tuple(int(i) for i in position // self.chunk)
            if at not in held:
                held[at] = self._get(level, at)
            state, body = held[at]
            x, y, z = (int(i) for i in position % self.chunk)
            width, height, _ = self.chunk
            states.append(state)
            values.append(body[(z * height + y) * width + x] if body else 0)
        return np.array(states), np.array(values, np.uint8)

    def values(self, level, positions):
        return self.chunks(level, positions)[1]

    def _get(self, level, at):
        x, y, z = at
        self.connection.request("GET", f"{self.path}/{level}/c/0/{z}/{y}/{x}")
        answer = self.connection.getresponse()
        body = answer.read()
        if answer.status == 404:
            return "absent", b""
        assert answer.status == 200, f"level {level} chunk {at}: {answer.status} {body[:200]}"
        # Without a tag it changed while it was read: equal to no other state.
        return answer.headers.get("ETag") or f"unstable {id(body)}", body

"""Neuroglancer in Chromium, drawn in software."""

import subprocess
import tempfile

import neuroglancer

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
# Values as they are, so that pixels can be compared.
SHADER = "void main() { emitGrayscale(toNormalized(getDataValue())); }"


class Page:
    """A page with one section of one volume."""

    def __init__(self, chromium, voxel_nm):
        neuroglancer.set_server_bind_address("127.0.0.1")
        self.viewer = neuroglancer.Viewer()
        self.space = neuroglancer.CoordinateSpace(names=["x", "y", "z"], units="nm", scales=voxel_nm)
        self.profile = tempfile.TemporaryDirectory(prefix="saccade-neuroglancer-", ignore_cleanup_errors=True)
        self.browser = subprocess.Popen(
            [chromium, *FLAGS, f"--user-data-dir={self.profile.name}", self.viewer.get_viewer_url()],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def section(self, source, position, size, scale=1, plane="xy"):
        """Gray values [down, right] around a position [level-0 voxels], `scale` of the shortest edges of voxels to a
        pixel, complete."""
        with self.viewer.txn() as state:
            state.dimensions = self.space
            state.layers.clear()
            state.layers["em"] = neuroglancer.ImageLayer(source=source, shader=SHADER)
            state.position = position
            state.layout = plane
            state.cross_section_scale = scale
            state.cross_section_background_color = "#000000"
            state.show_axis_lines = False
            state.show_scale_bar = False
            state.show_default_annotations = False
        return self.viewer.screenshot(size=size).screenshot.image_pixels[..., 0]

    def close(self):
        self.browser.terminate()
        self.browser.wait()
        neuroglancer.stop()
        self.profile.cleanup()

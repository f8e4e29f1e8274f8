#!/usr/bin/env python3
"""How many trilinear samples a second a bare CUDA kernel takes along the rays of a picture.

    cuda_samples.py RAYS.json

RAYS.json is what `saccade-bench --plots FOLDER render.vs_dense_texture` writes beside its plots: the rays, and how many
samples a second the renderer took along them. Needs NVIDIA's driver and Python alone. The kernel is `kernel.ptx`, made of
`kernel.cu`; `cuda_samples.py --compile LIBNVRTC` makes it anew, which needs no GPU.
"""

import ctypes as c
import hashlib
import json
import statistics
import struct
import sys
from pathlib import Path

HERE = Path(__file__).parent
SOURCE, PTX = HERE / "kernel.cu", HERE / "kernel.ptx"
RUNS = 9
BLOCK = (8, 8)


def made_of() -> str:
    """First line of a kernel that was made of the source as it is."""
    return f"// kernel.cu {hashlib.sha256(SOURCE.read_bytes()).hexdigest()}\n"


def compile_kernel(library: str) -> None:
    nvrtc = c.CDLL(library)
    program, size = c.c_void_p(), c.c_size_t()
    options = (c.c_char_p * 2)(b"--gpu-architecture=compute_70", b"--use_fast_math")
    nvrtc.nvrtcCreateProgram(c.byref(program), SOURCE.read_bytes(), b"kernel.cu", 0, None, None)
    failed = nvrtc.nvrtcCompileProgram(program, 2, options)
    if failed:
        nvrtc.nvrtcGetProgramLogSize(program, c.byref(size))
        log = c.create_string_buffer(size.value)
        nvrtc.nvrtcGetProgramLog(program, log)
        sys.exit(log.value.decode())
    nvrtc.nvrtcGetPTXSize(program, c.byref(size))
    text = c.create_string_buffer(size.value)
    nvrtc.nvrtcGetPTX(program, text)
    PTX.write_text(made_of() + text.value.decode())


class Array(c.Structure):
    """CUDA_ARRAY3D_DESCRIPTOR."""

    _fields_ = [("size", c.c_size_t * 3), ("format", c.c_uint), ("channels", c.c_uint), ("flags", c.c_uint)]


class Side(c.Structure):
    """One side of CUDA_MEMCPY3D."""

    _fields_ = [
        ("x_bytes_y_z_lod", c.c_size_t * 4),
        ("kind", c.c_uint),
        ("host", c.c_void_p),
        ("device", c.c_uint64),
        ("array", c.c_void_p),
        ("reserved", c.c_void_p),
        ("pitch", c.c_size_t),
        ("height", c.c_size_t),
    ]


class Copy(c.Structure):
    """CUDA_MEMCPY3D."""

    _fields_ = [("source", Side), ("target", Side), ("width_height_depth", c.c_size_t * 3)]


class Resource(c.Structure):
    """CUDA_RESOURCE_DESC of an array."""

    _fields_ = [("kind", c.c_uint), ("array", c.c_void_p), ("rest", c.c_byte * 120), ("flags", c.c_uint)]


class Texture(c.Structure):
    """CUDA_TEXTURE_DESC."""

    _fields_ = [
        ("address", c.c_uint * 3),
        ("filter", c.c_uint),
        ("flags", c.c_uint),
        ("anisotropy", c.c_uint),
        ("mip_filter", c.c_uint),
        ("mip_bias", c.c_float),
        ("mip_range", c.c_float * 2),
        ("border", c.c_float * 4),
        ("reserved", c.c_int * 12),
    ]


HOST, ARRAY = 1, 3
UNSIGNED_INT8, CLAMP, LINEAR, NORMALIZED_COORDINATES = 1, 1, 1, 2


class Driver:
    """libcuda, whose calls fail with words."""

    def __init__(self) -> None:
        try:
            self.library = c.CDLL("libcuda.so.1")
        except OSError as error:
            sys.exit(f"there is no NVIDIA driver here, which has libcuda.so.1: {error}")

    def __getattr__(self, name: str):
        function = getattr(self.library, name)

        def call(*arguments) -> None:
            code = function(*arguments)
            if code:
                text = c.c_char_p()
                self.library.cuGetErrorString(code, c.byref(text))
                sys.exit(f"{name}: {(text.value or b'').decode()} ({code})")

        return call


def tissue(extent: list[int]) -> bytes:
    """Any voxels do, as long as they differ: a texture unit reads them all alike."""
    state, row = 88_172_645, bytearray()
    for _ in range(65_521):
        state = (state * 1_103_515_245 + 12_345) % (1 << 31)
        row.append(state >> 23)
    count = extent[0] * extent[1] * extent[2]
    return (bytes(row) * (count // len(row) + 1))[:count]


def measure(rays: dict) -> dict:
    ptx = PTX.read_text()
    if not ptx.startswith(made_of()):
        sys.exit(f"{PTX.name} was not made of {SOURCE.name} as it is; make it anew with --compile")
    cuda = Driver()
    device, context, module, march = c.c_int(), c.c_void_p(), c.c_void_p(), c.c_void_p()
    cuda.cuInit(0)
    cuda.cuDeviceGet(c.byref(device), 0)
    cuda.cuDevicePrimaryCtxRetain(c.byref(context), device)
    cuda.cuCtxSetCurrent(context)
    cuda.cuModuleLoadData(c.byref(module), ptx.encode())
    cuda.cuModuleGetFunction(c.byref(march), module, b"march")

    extent = [int(n) for n in rays["extent"]]
    array, voxels = c.c_void_p(), tissue(extent)
    cuda.cuArray3DCreate_v2(c.byref(array), c.byref(Array((c.c_size_t * 3)(*extent), UNSIGNED_INT8, 1, 0)))
    copy = Copy(width_height_depth=(c.c_size_t * 3)(*extent))
    copy.source.kind, copy.target.kind, copy.target.array = HOST, ARRAY, array
    copy.source.host = c.cast(c.c_char_p(voxels), c.c_void_p)
    copy.source.pitch, copy.source.height = extent[0], extent[1]
    cuda.cuMemcpy3D_v2(c.byref(copy))
    texture = c.c_uint64()
    how = Texture(address=(c.c_uint * 3)(CLAMP, CLAMP, CLAMP), filter=LINEAR, flags=NORMALIZED_COORDINATES)
    cuda.cuTexObjectCreate(c.byref(texture), c.byref(Resource(kind=0, array=array)), c.byref(how), None)

    width, height = rays["size"]
    image, counts = c.c_uint64(), c.c_uint64()
    for buffer in (image, counts):
        cuda.cuMemAlloc_v2(c.byref(buffer), c.c_size_t(4 * width * height))
    vectors = [rays[name] for name in ("eye", "forward", "right", "down", "extent", "voxels_per_nm")]
    packed = b"".join(struct.pack("4f", *vector, 0.0) for vector in vectors)
    packed += struct.pack("4I", width, height, 0, 0) + struct.pack("4f", rays["step_voxels"], rays["extinction"], 0, 0)
    packed = c.create_string_buffer(packed, len(packed))
    values = [c.byref(texture), packed, c.byref(image), c.byref(counts)]
    arguments = (c.c_void_p * 4)(*(c.cast(value, c.c_void_p) for value in values))
    grid = [-(-n // edge) for n, edge in zip((width, height), BLOCK)]

    events = [c.c_void_p(), c.c_void_p()]
    for event in events:
        cuda.cuEventCreate(c.byref(event), 0)
    times = []
    for _ in range(RUNS + 1):
        cuda.cuEventRecord(events[0], None)
        cuda.cuLaunchKernel(march, *grid, 1, *BLOCK, 1, 0, None, arguments, None)
        cuda.cuEventRecord(events[1], None)
        cuda.cuEventSynchronize(events[1])
        ms = c.c_float()
        cuda.cuEventElapsedTime(c.byref(ms), *events)
        times.append(ms.value)
    taken = (c.c_uint * (width * height))()
    cuda.cuMemcpyDtoH_v2(taken, counts, c.c_size_t(c.sizeof(taken)))
    samples = sum(taken)
    if samples == 0:
        sys.exit("no ray met the volume: the rays are not those of a picture of it")
    # The first also loads the kernel.
    return {"samples": samples, "ms": statistics.median(times[1:]), "runs_ms": times[1:]}


def main() -> None:
    if len(sys.argv) == 3 and sys.argv[1] == "--compile":
        return compile_kernel(sys.argv[2])
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        sys.exit(__doc__)
    rays = json.loads(Path(sys.argv[1]).read_text())
    bare = measure(rays)
    per_s = bare["samples"] / bare["ms"] * 1e3
    ours = rays["renderer"]["samples"] / rays["renderer"]["ms"] * 1e3
    result = {"bare_kernel": bare | {"samples_per_s": per_s}, "renderer": rays["renderer"] | {"samples_per_s": ours}}
    print(json.dumps(result | {"ours_over_theirs": ours / per_s}, indent=2))


if __name__ == "__main__":
    main()

"""Open Image Denoise with clean auxiliary pictures, one filter per process.

The denoiser is deterministic for any number of threads (tested). `high` and `balanced` are not the
same here: with clean auxiliary pictures `high` is 1.6 dB better on sampled scenes (study S4).
"""

import ctypes
import functools
import importlib
import math
import sys
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.tracer import Features

Quality = Literal["high", "fast"]

_QUALITIES = {"high": "OIDN_QUALITY_HIGH", "fast": "OIDN_QUALITY_FAST"}
_INPUTS = ("color", "albedo", "normal")

DenoiserDevice = Literal["CPU", "CUDA"]
"""What Open Image Denoise runs on. It supports more GPUs, but Mitsuba renders on CUDA alone."""

_threads = 0
"""Threads of filters made from now on; 0 is all cores."""

_device: DenoiserDevice = "CPU"
"""The device of filters that are made from now on."""


def set_denoiser_threads(count: int) -> None:
    """Use `count` threads for every picture from now on."""
    global _threads
    _threads = count


def set_denoiser_device(device: DenoiserDevice) -> None:
    """Denoise every picture from now on with this device."""
    global _device
    _device = device


def denoise(
    radiance_rgb: NDArray[np.float32], features: Features, quality: Quality
) -> NDArray[np.float32]:
    """Return the picture without noise, exactly black where no ray hit anything.

    Args:
        radiance_rgb: [R, R, 3] finite and at least 0. Values that are not finite vanish in the
            filter without a trace: look for them before.
        features: albedo and normal, [R, R, 3] each, free of noise themselves.
        quality: of the network.
    """
    if not radiance_rgb.any():
        return np.zeros_like(radiance_rgb)  # the filter would paint the albedo, up to 0.003 bright
    filtered = _filter(radiance_rgb.shape[0], quality, _device, _threads)
    inputs = (radiance_rgb, features.albedo, features.normal)
    picture = filtered.run(dict(zip(_INPUTS, inputs, strict=True)))
    covered = np.any(features.normal != 0, axis=-1) | np.any(radiance_rgb != 0, axis=-1)
    return np.where(covered[..., None], np.maximum(picture, 0), np.float32(0))


def denoise_arrays(
    pictures: Sequence[Any], guides: Sequence[tuple[Any, Any]], resolution: int, quality: Quality
) -> list[Any]:
    """Return what the filter makes of pictures in Dr.Jit's memory, where it runs on that.

    Args:
        pictures: [3 R^2] mi.Float, pixel by pixel.
        guides: albedo and normal of each.
        resolution: R.
        quality: of the network.
    """
    import drjit as dr  # only after `activate`

    filtered = _filter(resolution, quality, _device, _threads)
    if (dr.backend_v(pictures[0]) == dr.JitBackend.CUDA) != (_device == "CUDA"):
        kind = type(pictures[0])
        shape = (resolution, resolution, 3)
        inputs = [
            [np.array(each).reshape(shape) for each in (p, *g)]
            for p, g in zip(pictures, guides, strict=True)
        ]
        return [
            kind(filtered.run(dict(zip(_INPUTS, each, strict=True))).ravel()) for each in inputs
        ]
    outputs = [dr.opaque(type(picture), 0, len(picture)) for picture in pictures]
    dr.eval(pictures, guides)
    dr.sync_thread()
    for picture, (albedo, normal), output in zip(pictures, guides, outputs, strict=True):
        filtered.run_in_place(
            {"color": picture, "albedo": albedo, "normal": normal, "output": output}
        )
    return outputs


class _Filter:
    """One filter, with memory of its own, which is the device's, or on arrays of Dr.Jit."""

    def __init__(
        self, resolution: int, quality: Quality, device: DenoiserDevice, threads: int
    ) -> None:
        oidn = load_oidn()
        self._device = open_device(device, threads)
        self._filter = oidn.Filter(self._device, oidn.OIDN_FILTER_TYPE_RT)
        self._shape = (resolution, resolution, 3)
        self._bytes = 4 * math.prod(self._shape)
        self._memory: dict[str, Any] = {}
        self._filter.set_bool("hdr", True)
        self._filter.set_bool("cleanAux", True)
        self._filter.set_quality(getattr(oidn, _QUALITIES[quality]))

    def run(self, inputs: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return the filtered picture of inputs [R, R, 3] by name."""
        if not self._memory:
            buffer = functools.partial(load_oidn().Buffer, self._device, self._bytes)
            self._memory = {name: buffer() for name in (*_INPUTS, "output")}
            self._use(self._memory)
        for name, values in inputs.items():
            self._memory[name].write(0, self._bytes, np.ascontiguousarray(values, np.float32))
        self._filter.execute()
        picture = np.zeros(self._shape, np.float32)
        self._memory["output"].read(0, self._bytes, picture)
        _check(self._device)
        return picture

    def run_in_place(self, arrays: dict[str, Any]) -> None:
        """Filter arrays of Dr.Jit by name, whose kernels have finished."""
        shared = load_oidn().Buffer.shared
        buffers = {
            name: shared(self._device, _address(array), self._bytes)
            for name, array in arrays.items()
        }
        self._memory = {}
        self._use(buffers)
        self._filter.execute()
        for buffer in buffers.values():
            buffer.release()
        _check(self._device)

    def _use(self, buffers: dict[str, Any]) -> None:
        """Set the memory of inputs and output; for another one, too, this takes microseconds."""
        height, width, _ = self._shape
        for name, buffer in buffers.items():
            form = load_oidn().OIDN_FORMAT_FLOAT3
            self._filter.set_image(name, buffer, form, width=width, height=height)
        self._filter.commit()
        _check(self._device)


class _DLTensor(ctypes.Structure):
    """The head of DLPack's structure of that name."""

    _fields_ = (
        ("data", ctypes.c_void_p),
        ("device", ctypes.c_int32 * 2),
        ("ndim", ctypes.c_int32),
        ("dtype", ctypes.c_uint8 * 4),
        ("shape", ctypes.c_void_p),
        ("strides", ctypes.c_void_p),
        ("byte_offset", ctypes.c_uint64),
    )


_capsule_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_capsule_pointer.restype = ctypes.c_void_p
_capsule_pointer.argtypes = [ctypes.py_object, ctypes.c_char_p]


def _address(array: Any) -> int:
    """Return where an evaluated array of Dr.Jit is, in the memory of its device."""
    capsule = array.__dlpack__()
    tensor = _DLTensor.from_address(_capsule_pointer(capsule, b"dltensor"))
    return int(tensor.data) + int(tensor.byte_offset)


def open_device(device: DenoiserDevice, threads: int = 0) -> Any:
    """Return a device of Open Image Denoise; raises RuntimeError where there is none.

    Args:
        device: CPU, or CUDA for the first GPU, on which Mitsuba renders too.
        threads: of the processor; 0 is all cores.
    """
    oidn = load_oidn()
    opened = oidn.Device(getattr(oidn, f"OIDN_DEVICE_TYPE_{device}"))
    if device == "CPU":
        if threads:
            opened.set_int("numThreads", threads)
        # Pinned threads of two workers would share the same cores.
        opened.set_bool("setAffinity", False)
    opened.commit()
    _check(opened)
    return opened


def gpu_is_supported() -> bool:
    """Return whether Open Image Denoise can run on the first GPU (CUDA)."""
    return bool(load_oidn().Device.is_cuda_available())


def _check(device: Any) -> None:
    message = device.get_error()
    if message is not None:
        raise RuntimeError(f"Open Image Denoise: {message}")


@functools.cache
def _filter(resolution: int, quality: Quality, device: DenoiserDevice, threads: int) -> _Filter:
    return _Filter(resolution, quality, device, threads)


def load_oidn() -> Any:
    """Import pyoidn without the torch that it would load for nothing (1.2 s, 200 MB)."""
    if "torch" in sys.modules:
        return importlib.import_module("pyoidn")
    sys.modules["torch"] = None  # type: ignore[assignment]  # makes `import torch` fail
    try:
        return importlib.import_module("pyoidn")
    finally:
        del sys.modules["torch"]

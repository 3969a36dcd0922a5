"""Denoising by Open Image Denoise (OIDN) with clean auxiliary pictures, one filter per thread.

The denoiser is deterministic for any number of threads (tested). `high` and `balanced` are not the
same here: with clean auxiliary pictures `high` is 1.6 dB better on sampled scenes (study S4).
"""

import functools
import importlib
import math
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Quality = Literal["high", "fast"]

INPUTS = ("color", "albedo", "normal")

DenoiserDevice = Literal["CPU", "CUDA"]
"""What Open Image Denoise runs on. It supports more GPUs, but Mitsuba renders on CUDA alone."""

_threads = 0
"""Threads of filters made from now on; 0 is all cores."""

_device: DenoiserDevice = "CPU"
"""The device of filters that are made from now on."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """What guides the denoiser, averaged over the area of each pixel."""

    albedo: NDArray[np.float32]
    """[R, R, 3] diffuse + specular albedo of the first surface, 0 where there is none."""
    normal: NDArray[np.float32]
    """[R, R, 3] its shading normal in world space, 0 where there is none."""


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
    inputs = (radiance_rgb, features.albedo, features.normal)
    opened = open_filter(radiance_rgb.shape[0], quality)
    picture = opened.run(dict(zip(INPUTS, inputs, strict=True)))
    covered = np.any(features.normal != 0, axis=-1) | np.any(radiance_rgb != 0, axis=-1)
    return np.where(covered[..., None], np.maximum(picture, 0), np.float32(0))


class Filter:
    """One filter, with memory of its own, which is the device's, or with shared memory."""

    def __init__(
        self, resolution: int, quality: Quality, device: DenoiserDevice, threads: int
    ) -> None:
        oidn = load_oidn()
        self.is_on_gpu = device == "CUDA"
        self._device = open_device(device, threads)
        self._filter = oidn.Filter(self._device, oidn.OIDN_FILTER_TYPE_RT)
        self._shape = (resolution, resolution, 3)
        self._bytes = 4 * math.prod(self._shape)
        self._memory: dict[str, Any] = {}
        self._filter.set_bool("hdr", True)
        self._filter.set_bool("cleanAux", True)
        self._filter.set_quality(getattr(oidn, f"OIDN_QUALITY_{quality.upper()}"))

    def run(self, inputs: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return the filtered picture of inputs [R, R, 3] by name."""
        if not self._memory:
            buffer = functools.partial(load_oidn().Buffer, self._device, self._bytes)
            self._memory = {name: buffer() for name in (*INPUTS, "output")}
            self._use(self._memory)
        for name, values in inputs.items():
            self._memory[name].write(0, self._bytes, np.ascontiguousarray(values, np.float32))
        self._filter.execute()
        picture = np.zeros(self._shape, np.float32)
        self._memory["output"].read(0, self._bytes, picture)
        _check(self._device)
        return picture

    def run_in_place(self, addresses: Mapping[str, int]) -> None:
        """Filter float32 [R, R, 3] at addresses of the device by name, with the output's."""
        shared = load_oidn().Buffer.shared
        buffers = {
            name: shared(self._device, address, self._bytes) for name, address in addresses.items()
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


def open_filter(
    resolution: int,
    quality: Quality,
    threads: int | None = None,
    device: DenoiserDevice | None = None,
) -> Filter:
    """Return this thread's filter of square pictures, `resolution` pixels wide.

    None is what `set_denoiser_threads` and `set_denoiser_device` say.
    """
    threads = _threads if threads is None else threads
    return _filter(resolution, quality, device or _device, threads, threading.get_ident())


@functools.lru_cache(maxsize=16)
def _filter(
    resolution: int, quality: Quality, device: DenoiserDevice, threads: int, thread: int
) -> Filter:
    """Return a filter of a thread: two threads would write into the same memory."""
    return Filter(resolution, quality, device, threads)


def load_oidn() -> Any:
    """Import pyoidn without the torch that it would load for nothing (1.2 s, 200 MB)."""
    if "torch" in sys.modules:
        return importlib.import_module("pyoidn")
    sys.modules["torch"] = None  # type: ignore[assignment]  # makes `import torch` fail
    try:
        return importlib.import_module("pyoidn")
    finally:
        del sys.modules["torch"]

"""Open Image Denoise with clean auxiliary pictures, one filter per process.

The denoiser is deterministic for any number of threads (tested). `high` and `balanced` are not the
same here: with clean auxiliary pictures `high` is 1.6 dB better on sampled scenes (study S4).
"""

import functools
import importlib
import math
import sys
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.tracer import Features

Quality = Literal["high", "fast"]

_QUALITIES = {"high": "OIDN_QUALITY_HIGH", "fast": "OIDN_QUALITY_FAST"}
_INPUTS = ("color", "albedo", "normal")

DenoiserDevice = Literal["CPU", "CUDA"]
"""What Open Image Denoise runs on. It supports more cards, but Mitsuba renders on CUDA alone."""

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
    """Return the picture without noise, exactly black where no ray met anything.

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
    met = np.any(features.normal != 0, axis=-1) | np.any(radiance_rgb != 0, axis=-1)
    return np.where(met[..., None], np.maximum(picture, 0), np.float32(0))


class _Filter:
    """One committed filter with the memory that it reads and writes, which is the device's own."""

    def __init__(
        self, resolution: int, quality: Quality, device: DenoiserDevice, threads: int
    ) -> None:
        oidn = load_oidn()
        self._device = open_device(device, threads)
        self._filter = oidn.Filter(self._device, oidn.OIDN_FILTER_TYPE_RT)
        self._shape = (resolution, resolution, 3)
        self._bytes = 4 * math.prod(self._shape)
        self._memory = {
            name: oidn.Buffer(self._device, self._bytes) for name in (*_INPUTS, "output")
        }
        for name, memory in self._memory.items():
            size = {"width": resolution, "height": resolution}
            self._filter.set_image(name, memory, oidn.OIDN_FORMAT_FLOAT3, **size)
        self._filter.set_bool("hdr", True)
        self._filter.set_bool("cleanAux", True)
        self._filter.set_quality(getattr(oidn, _QUALITIES[quality]))
        self._filter.commit()
        _check(self._device)

    def run(self, inputs: dict[str, NDArray[np.float32]]) -> NDArray[np.float32]:
        for name, values in inputs.items():
            self._memory[name].write(0, self._bytes, np.ascontiguousarray(values, np.float32))
        self._filter.execute()
        picture = np.zeros(self._shape, np.float32)
        self._memory["output"].read(0, self._bytes, picture)
        _check(self._device)
        return picture


def open_device(device: DenoiserDevice, threads: int = 0) -> Any:
    """Return a device of Open Image Denoise; raises RuntimeError where there is none.

    Args:
        device: what it runs on. A card is the first one, on which Mitsuba renders too.
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


def card_is_supported() -> bool:
    """Return whether Open Image Denoise can run on the first graphics card (CUDA)."""
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

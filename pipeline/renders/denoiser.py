"""Denoising by Open Image Denoise (OIDN) on arrays of Dr.Jit, where they are."""

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from storage.denoiser import INPUTS, Quality, open_filter


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

    opened = open_filter(resolution, quality)
    if (dr.backend_v(pictures[0]) == dr.JitBackend.CUDA) != opened.is_on_gpu:
        kind = type(pictures[0])
        shape = (resolution, resolution, 3)
        inputs = [
            [np.array(each).reshape(shape) for each in (p, *g)]
            for p, g in zip(pictures, guides, strict=True)
        ]
        return [kind(opened.run(dict(zip(INPUTS, each, strict=True))).ravel()) for each in inputs]
    outputs = [dr.opaque(type(picture), 0, len(picture)) for picture in pictures]
    dr.eval(pictures, guides)
    dr.sync_thread()
    for picture, (albedo, normal), output in zip(pictures, guides, outputs, strict=True):
        arrays = {"color": picture, "albedo": albedo, "normal": normal, "output": output}
        opened.run_in_place({name: _address(array) for name, array in arrays.items()})
    return outputs


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

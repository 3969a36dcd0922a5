"""What the bytes of a dataset depend on beside its settings: processor, variant, libraries."""

import platform
import zlib
from importlib import metadata
from pathlib import Path
from typing import Any

from pipeline.renders.variant import Variant

_LIBRARIES = (
    "trilight",
    "mitsuba",
    "drjit",
    "pyoidn",
    "numpy",
    "scipy",
    "trimesh",
    "pymeshlab",
    "OpenEXR",
    "safetensors",
)
_VECTOR_EXTENSIONS = ("avx512f", "avx2", "sse4_2", "asimd")


def environment(variant: Variant) -> dict[str, Any]:
    """Return what a dataset must agree on to keep its digest, as JSON values."""
    # Only where it is not the processor: what was made before this could be said stays the same.
    on_card = {} if variant.denoiser == "CPU" else {"denoiser_device": variant.denoiser}
    return {
        **on_card,
        "mitsuba_variant": variant.name,
        "llvm": Path(variant.libllvm).name,
        "processor": f"{platform.machine()} {vector_extension()}".strip(),
        "libraries": {
            **{name: _version(name) for name in _LIBRARIES},
            "zlib": zlib.ZLIB_RUNTIME_VERSION,  # Python's own, which packs the arrays of scenes
        },
    }


def vector_extension() -> str:
    """Return the widest vector extension of this processor that compilers use, or nothing."""
    try:
        flags = Path("/proc/cpuinfo").read_text().split()
    except OSError:
        return ""
    return next((name for name in _VECTOR_EXTENSIONS if name in flags), "")


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"

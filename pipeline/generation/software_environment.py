"""Software environment that decides a dataset's bytes beside its settings: processor, libraries."""

import platform
import zlib
from importlib import metadata
from pathlib import Path
from typing import Any

from pipeline.renders.mitsuba_variant import Variant

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
    """Return the processor, variant and library versions that decide a digest, as JSON values."""
    # Stated only for a GPU, so that manifests from before this field stay equal.
    gpu_denoiser = {} if variant.denoiser == "CPU" else {"denoiser_device": variant.denoiser}
    return {
        **gpu_denoiser,
        "mitsuba_variant": variant.name,
        "llvm": Path(variant.libllvm).name,
        "processor": f"{platform.machine()} {vector_extension()}".strip(),
        "libraries": {
            **{name: _version(name) for name in _LIBRARIES},
            "zlib": zlib.ZLIB_RUNTIME_VERSION,  # Python's own: compresses the arrays of scenes
        },
    }


def vector_extension() -> str:
    """Return the widest vector extension of this processor that compilers use, or an empty text."""
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

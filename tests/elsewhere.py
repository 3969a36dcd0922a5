"""The tests that fail first on another processor, run as on one: `make test-elsewhere`.

Each library chooses its loops by what the processor can do, and sums in another order in each, so
that a float which is taken for an identity, a tolerance or a stored digest may hold on one machine
only. Each also has a variable by which it does without: one machine stands for many.

Run `python -m tests.elsewhere avx2 tests/pipeline/scenes` for other tests; without any, the chosen
ones.
"""

import ctypes
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ASKED = "TRILIGHT_TESTS_ELSEWHERE"

PROCESSORS: Mapping[str, Mapping[str, str]] = {
    "avx2": {  # Intel since 2013 without AVX-512, and AMD until 2022
        "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
        "OPENBLAS_CORETYPE": "Haswell",
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL",
    },
    "sse4": {  # no fused multiply-add: every product is rounded
        "ATEN_CPU_CAPABILITY": "default",
        "ONEDNN_MAX_CPU_ISA": "SSE41",
        "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX,-AVX2,-FMA,-FMA4,-AVX512F,-AVX512VL",
    },
}
"""Variables of torch, oneDNN, MKL, OpenBLAS, numpy and glibc (exp and sin of doubles)."""

LLVM_TARGET = ("haswell", 8)
"""What Dr.Jit compiles for in both, and its lanes: the least that it supports."""

CHOSEN = (
    "tests/pipeline/presets/test_registry.py",
    "tests/model/hits/test_decoder.py",
    "tests/model/hits/test_view_inputs.py",
    "tests/model/test_open.py",
    "tests/model/test_inference.py",
    "tests/model/test_renderformer.py",
    "tests/pipeline/objects/builtin/test_builtin.py",
    "tests/laws/test_light_laws.py",
    "tests/pipeline/renders/test_stored_pictures.py",
    "tests/pipeline/scenes/test_compose.py",
    "tests/pipeline/scenes/test_views.py",
    "tests/scene_templates/skies/test_procedural_skies.py",
    "tests/scene_templates/surfaces/test_procedural_textures.py",
    "tests/storage/test_metrics.py",
    "tests/storage/dataset/test_shard.py",
    "tests/train/data/test_augment.py",
    "tests/train/data/test_loader.py",
    "tests/train/evaluation/test_validation.py",
    "tests/train/loop/test_optimizer.py",
    "tests/train/loop/test_step.py",
    "tests/train/loss/test_training_loss.py",
    "tests/train/loop/test_processes.py",
    "tests/train/test_run_training.py",
)
"""Where bytes, digests, stored numbers and close tolerances are compared, cheaply."""


def pytest_configure(config: pytest.Config) -> None:
    """Have Dr.Jit compile for the other processor, once Mitsuba is there; see that numpy obeys."""
    import numpy as np

    from pipeline.renders import mitsuba_variant as variants

    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", ())
    left = set(found) & set(PROCESSORS[os.environ[ASKED]]["NPY_DISABLE_CPU_FEATURES"].split())
    if left:
        raise pytest.UsageError(f"numpy still uses {left}; has its variable another name now?")
    activate = variants.activate

    def activate_elsewhere(variant: variants.Variant) -> None:
        activate(variant)
        if variant.name == "llvm_ad_rgb":
            _compile_for(*LLVM_TARGET)

    variants.activate = activate_elsewhere


def _compile_for(processor: str, lanes: int) -> None:
    """Dr.Jit has this in C++ alone, under the name that its compiler gave it."""
    import drjit

    library = ctypes.CDLL(str(Path(drjit.__file__).parent / "libdrjit-core.so"))
    set_target = library._Z19jit_llvm_set_targetPKcS0_j
    set_target.argtypes = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint]
    set_target.restype = None
    set_target(processor.encode(), None, lanes)


def _others() -> list[str]:
    """Return the processors that this one is not: `make test` has run as what it is."""
    import numpy as np

    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", ())
    return [name for name in PROCESSORS if name != "avx2" or "X86_V4" in found]


def main() -> int:
    """Run tests as each other processor, or as the named one; return the exit status."""
    named, tests = sys.argv[1:2], sys.argv[2:] or CHOSEN
    for name in named or _others():
        options = ("-n", "2", "--dist", "worksteal", "-p", "tests.elsewhere")
        command = [sys.executable, "-m", "pytest", *options, *tests]
        status = subprocess.call(
            command, cwd=ROOT, env=os.environ | PROCESSORS[name] | {ASKED: name}
        )
        if status:
            return status
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

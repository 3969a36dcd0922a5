"""Facts of what renders here, for people and for logs; asked in a process of its own."""

import json
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

from pipeline.isolation import die_with_parent
from pipeline.renders.mitsuba_variant import Variant, activate, run_module
from storage.denoiser import open_device
from storage.installation import child_environment

_ASK_S = 120

VIEW_PX = 256
"""Width of the picture that is timed, pixels."""
VIEW_SPP = 128
"""Its samples per pixel."""


def render_facts(variant: Variant) -> dict[str, str]:
    """Return versions, devices, threads and seconds of a view by name, as far as known in time."""
    facts = {name: metadata.version(name) for name in ("mitsuba", "drjit", "pyoidn")}
    facts |= {"variant": variant.name, "llvm": Path(variant.libllvm).name}
    try:
        result = run_module("facts", json.dumps(vars(variant)), _ASK_S, child_environment())
    except subprocess.TimeoutExpired:  # a busy machine
        return facts
    return facts | json.loads(result.stdout) if result.returncode == 0 else facts


def _answer(variant: Variant) -> dict[str, str]:
    activate(variant)
    import drjit

    version = open_device(variant.denoiser).get_int("version")
    return {
        "threads": str(drjit.thread_count()),
        "denoiser": f"{version // 10000}.{version // 100 % 100}.{version % 100}",
        "denoiser_device": variant.denoiser,
        "view_s": f"{_view_seconds():.2g}",
    }


def _view_seconds() -> float:
    """Return the wall-clock seconds of a view of the probe's scene, once kernels are compiled."""
    from pipeline.renders.variant_probe import load_probe

    render_view = load_probe(VIEW_PX, VIEW_SPP)
    seconds = []
    for seed in range(3):
        began = time.perf_counter()
        render_view(seed)
        seconds.append(time.perf_counter() - began)
    return min(seconds)


if __name__ == "__main__":
    die_with_parent()
    sys.stdout.write(json.dumps(_answer(Variant(**json.loads(sys.argv[1])))))

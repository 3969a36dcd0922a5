"""Chooses the Mitsuba variant of this machine, by rendering a small picture with each.

LLVM is loaded at run time, and a library that loads may still abort the whole process while it
compiles (LLVM 15 does, "Cannot select: fminimum"). So each candidate renders a small picture in a
process of its own, without any kernel that another library compiled, and must meet the stored one
within its noise. The answer is remembered.

A GPU is used only after the same probe; its answer is remembered for this driver. It denoises as
well if Open Image Denoise gives the same picture on it as on the CPU.

Nothing here imports mitsuba, except `activate`.
"""

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from pipeline.renders import probe_picture
from pipeline.renders.denoiser import DenoiserDevice, set_denoiser_device
from pipeline.renders.llvm_libraries import llvm_libraries
from pipeline.renders.visible_gpus import gpu_identity, visible_gpus
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.digests import canonical_json, sha256_hex
from storage.errors import EnvironmentFailure, TrilightError
from storage.installation import IMPORT_ROOT, child_environment
from storage.typed_json import read_json

_PROBE_S = (180, 360)
"""Wall time of a probe, and of a second try where the first gave no answer: many may start at once,
on a machine that is busy."""
_REMEMBERED_TRIES = 32

_RAYS_LEFT_OUT = "Disabling this ray tracing operation"
"""Dr.Jit only logs this where a kernel is too large for OptiX; it raises no error."""


VariantName = Literal["llvm_ad_rgb", "cuda_ad_rgb"]

Device = Literal["cpu", "gpu", "auto"]
"""What traces pictures; `auto` is a GPU where one passes the probe, or else the CPU."""

_ASK = "TRILIGHT_VARIANT"
_DEVICES: Mapping[str, Device] = {"llvm_ad_rgb": "cpu", "cuda_ad_rgb": "gpu"}


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Mitsuba variant, with its libraries and devices."""

    name: VariantName
    """Name of the Mitsuba variant, with its backend and color mode."""
    libllvm: str
    """The LLVM library that it compiles with; empty on a GPU."""
    note: str
    """Note for the user about this choice; empty if there is none."""
    denoiser: DenoiserDevice = "CPU"
    """Device of Open Image Denoise."""

    @property
    def device(self) -> Device:
        """`cpu` or `gpu`."""
        return _DEVICES[self.name]

    def address_space(self, num_bytes: int) -> int:
        """Return the limit of a child: `num_bytes`, or far more for CUDA, which maps all memory."""
        return num_bytes if self.device == "cpu" else 1 << 46


def device_of(environment: Mapping[str, Any]) -> Device:
    """Return the device of a dataset by its environment (pipeline.generation.environment)."""
    return _DEVICES.get(str(environment.get("mitsuba_variant")), "cpu")


def named_device() -> Device | None:
    """Return the device that TRILIGHT_VARIANT names; raises TrilightError if it names none."""
    name = os.environ.get(_ASK, "")
    if name not in ("", *_DEVICES):
        raise TrilightError(f"{_ASK} is {name!r}; expected one of {', '.join(_DEVICES)}, or none.")
    return _DEVICES.get(name)


def choose_variant(default: Device = "cpu", *, device: Device | None = None) -> Variant:
    """Return the variant of a device, on a CPU with the newest LLVM library that works.

    Later calls read the remembered probes.

    Args:
        default: device where neither `device` nor TRILIGHT_VARIANT names one.
        device: device of an option or a dataset, before which TRILIGHT_VARIANT does not count.

    Raises:
        TrilightError: no LLVM library works here; TRILIGHT_VARIANT names no variant; a GPU is named
            and renders no right picture.
        EnvironmentFailure: a probe gave no answer, which says nothing about its library: with
            another one, the same dataset would be of other bytes.
    """
    chosen = device or named_device() or default
    if chosen == "cpu" or (chosen == "auto" and not visible_gpus()):
        return _on_processor()
    probed = _probe_gpu(retry_failed=chosen == "gpu")
    if not probed.problem:
        note = (
            probed.denoiser_problem and f"{probed.denoiser_problem}, so the CPU denoises pictures"
        )
        return dataclasses.replace(_GPU, denoiser="CPU" if note else "CUDA", note=note)
    if chosen == "auto":
        note = f"the GPU renders no right picture ({probed.problem}), so the CPU renders"
        return dataclasses.replace(_on_processor(), note=note)
    raise TrilightError(
        f"rendering on a GPU: no right picture could be rendered with it here ({probed.problem}); "
        f"expected one of CUDA with OptiX. Choose --device cpu, or unset {_ASK}."
    )


def _probe_gpu(*, retry_failed: bool) -> "_ProbeResult":
    """Return the result of a probe of the GPU, remembered or new.

    Args:
        retry_failed: whether a remembered problem is probed again: its cause may be fixed.
    """
    memory = cache_folder("gpu_probes.json")
    identity = _gpu_identity()
    known: dict[str, tuple[str, str, str]] = {}
    with contextlib.suppress(TrilightError):  # damaged: probed again
        for text in _read_memory(memory):
            row = read_json(text, tuple[str, str, str], str(memory))
            known[row[0]] = row
    if last := known.pop(identity, None):
        _, problem, denoiser_problem = last
        if not (problem and retry_failed):
            return _ProbeResult(problem=problem, denoiser_problem=denoiser_problem)
    probed = _probe(_GPU)
    known[identity] = (identity, probed.problem, probed.denoiser_problem)
    _remember(memory, [json.dumps(row) for row in known.values()])
    return probed


def _on_processor() -> Variant:
    tried = []
    for library in llvm_libraries():
        if _works(library):
            return Variant(name="llvm_ad_rgb", libllvm=str(library), note="")
        tried.append(library.name)
    reason = f"of {', '.join(tried)} none works with Mitsuba" if tried else "no LLVM library found"
    raise TrilightError(
        f"rendering: {reason}; expected LLVM, by which Mitsuba compiles. Install it: "
        "pip install karellen-llvm-core."
    )


def activate(variant: Variant) -> None:
    """Make Mitsuba ready in this process; call before anything imports mitsuba.

    Compiled kernels are kept below the cache folder, apart for each LLVM library: Dr.Jit itself
    would run kernels of one library under another.
    """
    if variant.libllvm:
        os.environ["DRJIT_LIBLLVM_PATH"] = variant.libllvm
        kernels = cache_folder("kernels") / _identity(Path(variant.libllvm))[:16]
        with contextlib.suppress(OSError):  # a cache that cannot be written costs time, no more
            kernels.mkdir(parents=True, exist_ok=True)
            os.environ["DRJIT_CACHE_DIR"] = str(kernels)
    import mitsuba

    mitsuba.set_variant(variant.name)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    set_denoiser_device(variant.denoiser)


def _works(library: Path) -> bool:
    """Return whether Mitsuba renders with a library, from memory or by a probe.

    Only success is remembered: the cause of a failure may have been mended since.

    Raises:
        EnvironmentFailure: the probe gave no answer.
    """
    memory = cache_folder("llvm_probes.json")
    identity = sha256_hex(canonical_json([_identity(library), probe_picture.TABLE]))
    known = _read_memory(memory)
    if identity in known:
        return True
    probed = _probe(Variant(name="llvm_ad_rgb", libllvm=str(library), note=""))
    if probed.is_silent:
        raise EnvironmentFailure(
            f"{library}: the probe of this LLVM library gave {probed.problem}, at {len(_PROBE_S)} "
            "tries; expected a small picture within seconds. Run again when the machine is less "
            "busy; if the library hangs, name another one by DRJIT_LIBLLVM_PATH."
        )
    if probed.problem:
        return False
    _remember(memory, [*known, identity])
    return True


def _remember(memory: Path, known: list[str]) -> None:
    with contextlib.suppress(TrilightError):  # remembered next time, or probed again
        write_atomically(memory, json.dumps(known[-_REMEMBERED_TRIES:]).encode())


def _read_memory(memory: Path) -> list[str]:
    try:
        return read_json(memory.read_bytes(), list[str], str(memory))
    except (OSError, TrilightError):
        return []


def _identity(library: Path) -> str:
    """Return a name that changes whenever the library or Mitsuba does."""
    status = library.stat()
    versions = [metadata.version(name) for name in ("mitsuba", "drjit")]
    return sha256_hex(canonical_json([str(library), status.st_mtime_ns, status.st_size, *versions]))


def _gpu_identity() -> str:
    """Return a name that changes whenever the GPUs, their driver, or what renders does."""
    versions = [metadata.version(name) for name in ("mitsuba", "drjit", "pyoidn")]
    return sha256_hex(canonical_json([gpu_identity(), *versions, probe_picture.TABLE]))


@dataclass(frozen=True, kw_only=True)
class _ProbeResult:
    """Result of a probe."""

    problem: str = ""
    """Reason why the variant cannot be used; empty if it can."""
    is_silent: bool = False
    """True if there was no answer in time, which a busy machine may cause."""
    denoiser_problem: str = ""
    """Reason why its GPU cannot denoise; empty if it can, or if there is no GPU."""


_GPU = Variant(name="cuda_ad_rgb", libllvm="", note="", denoiser="CUDA")


def _probe(variant: Variant) -> _ProbeResult:
    """Render a small picture in a child, and once more where it gave no answer."""
    result = _probe_within(variant, _PROBE_S[0])
    for wall_s in _PROBE_S[1:]:
        if result.is_silent:
            result = _probe_within(variant, wall_s)
    return result


def _probe_within(variant: Variant, wall_s: float) -> _ProbeResult:
    """Render a small picture in a child; an abort, a hang or a wrong picture is a problem."""
    with tempfile.TemporaryDirectory() as kernels:
        environment = {**child_environment(), "DRJIT_CACHE_DIR": kernels}
        if variant.libllvm:
            environment["DRJIT_LIBLLVM_PATH"] = variant.libllvm
        try:
            result = subprocess.run(
                [sys.executable, "-m", f"{__package__}.variant_probe", variant.name],
                cwd=IMPORT_ROOT,
                env=environment,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=wall_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return _ProbeResult(problem=f"no answer within {wall_s:g} s", is_silent=True)
    if _RAYS_LEFT_OUT in result.stderr:
        return _ProbeResult(problem="Dr.Jit left out some of the rays")
    if result.returncode == 0:
        return _ProbeResult(denoiser_problem=result.stdout.strip())
    lines = result.stderr.strip().splitlines()
    return _ProbeResult(problem=lines[-1] if lines else f"it ended with status {result.returncode}")

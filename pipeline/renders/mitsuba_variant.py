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
import platform
import re
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.denoiser import DenoiserDevice, set_denoiser_device
from storage.digests import canonical_json, sha256_hex
from storage.errors import EnvironmentFailure, TrilightError
from storage.installation import IMPORT_ROOT, child_environment, installed_version
from storage.typed_json import read_json

_PROBE_S = (180, 360)
"""Wall time of a probe, and of a second try where the first gave no answer: many may start at once,
on a machine that is busy."""
_REMEMBERED_TRIES = 32

_version = partial(installed_version, otherwise="not installed")

_RAYS_LEFT_OUT = "Disabling this ray tracing operation"
"""Dr.Jit only logs this where a kernel is too large for OptiX; it raises no error."""


PROBE_PICTURE = """
0.02642 0.01907 0.01140 0.0002921 0.0001690 6.412e-05
0.07167 0.05284 0.03035 0.0003407 0.0003220 8.808e-05
0.03219 0.02473 0.01407 0.0002694 0.0003256 6.697e-05
0.01020 0.007436 0.004571 0.0002357 0.0001461 5.090e-05
0.04946 0.03132 0.01544 0.0008953 0.0004946 0.0001695
0.04933 0.03792 0.01681 0.0008166 0.0005259 0.0001596
0.02762 0.02673 0.01053 0.0006331 0.0004875 0.0001281
0.02206 0.01789 0.007704 0.0005913 0.0003370 0.0001136
0.08784 0.06104 0.03826 0.0006802 0.0004250 0.0001939
0.04782 0.04380 0.02195 0.0004827 0.0003253 0.0001424
0.009158 0.02190 0.005475 4.609e-05 9.437e-05 1.411e-05
0.02014 0.02160 0.009289 0.0003597 0.0002455 0.0001096
0.1086 0.07708 0.05013 0.0005907 0.0003705 0.0001748
0.1035 0.07626 0.04860 0.0004233 0.0002804 0.0001276
0.08441 0.06418 0.04021 7.366e-05 0.0001190 2.842e-05
0.06741 0.05008 0.03187 0.0002304 0.0001623 7.051e-05
"""
"""The right picture of pipeline.renders.variant_probe. A line is a block, row after row: the mean
of R, G and B, and their standard deviations.

Printed by tests.pipeline.renders.probe_reference: the mean of 1,024 pictures, of which one has this
standard deviation. Print it anew only when the light itself or the probe's scene is meant to
change.
"""

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

    @property
    def device(self) -> Device:
        """`cpu` or `gpu`."""
        return _DEVICES[self.name]

    def address_space(self, num_bytes: int) -> int:
        """Return the limit of a child: `num_bytes`, or far more for CUDA, which maps all memory."""
        return num_bytes if self.device == "cpu" else 1 << 46


def device_of(environment: Mapping[str, Any]) -> Device:
    """Return the device in a dataset's `environment`."""
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
        default, device: as `choose_gpu`.

    Raises:
        TrilightError: as `choose_gpu`, or no LLVM library works here.
        EnvironmentFailure: a probe gave no answer, which says nothing about its library: with
            another one, the same dataset would be of other bytes.
    """
    gpu, note = choose_gpu(default, device=device)
    return gpu or dataclasses.replace(_on_processor(), note=note)


def choose_gpu(default: Device, *, device: Device | None = None) -> tuple[Variant | None, str]:
    """Return the variant of a GPU, or None and a note for the user where the CPU is to work.

    Args:
        default: device where neither `device` nor TRILIGHT_VARIANT names one.
        device: device of an option or a dataset, before which TRILIGHT_VARIANT does not count.

    Raises:
        TrilightError: TRILIGHT_VARIANT names no variant; a GPU is named and renders no right
            picture.
    """
    chosen = device or named_device() or default
    if chosen == "cpu" or (chosen == "auto" and not visible_gpus()):
        return None, ""
    if not visible_gpus():
        raise _refused_gpu(device, "no NVIDIA GPU is visible here")
    versions = map(_version, ("mitsuba", "drjit", "pyoidn"))
    identity = sha256_hex(canonical_json([gpu_identity(), *versions, PROBE_PICTURE]))
    probed = _remembered_probe(_GPU, identity, retry_failed=chosen == "gpu")
    if not probed.problem:
        note = (
            probed.denoiser_problem and f"{probed.denoiser_problem}, so the CPU denoises pictures"
        )
        return dataclasses.replace(_GPU, denoiser="CPU" if note else "CUDA", note=note), ""
    if chosen == "auto":
        return None, f"the GPU renders no right picture ({probed.problem}), so the CPU renders"
    raise _refused_gpu(device, f"the GPU renders no right picture ({probed.problem})")


def _refused_gpu(device: Device | None, said: str) -> TrilightError:
    """Return the complaint of a GPU that an option, TRILIGHT_VARIANT or a dataset asks for."""
    reason = "the dataset was begun on a GPU"
    step = "Choose --device cpu"
    if device is not None:
        reason = f"--device is {device}"
    elif named_device():
        reason = f"{_ASK} is {_GPU.name}"
        step = f"Unset {_ASK}"
    return TrilightError(f"{reason}, and {said}; expected a GPU with CUDA and OptiX. {step}.")


def _on_processor() -> Variant:
    tried = []
    for library in llvm_libraries():
        variant = Variant(name="llvm_ad_rgb", libllvm=str(library), note="")
        identity = sha256_hex(canonical_json([_identity(library), PROBE_PICTURE]))
        probed = _remembered_probe(variant, identity, retry_failed=True)
        if probed.is_silent:
            raise EnvironmentFailure(
                f"{library}: the probe of this LLVM library gave {probed.problem}, at "
                f"{len(_PROBE_S)} tries; expected a small picture within seconds. Run again when "
                "the machine is less busy; if the library hangs, name another one by "
                "DRJIT_LIBLLVM_PATH."
            )
        if not probed.problem:
            return variant
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


def _remembered_probe(variant: Variant, identity: str, *, retry_failed: bool) -> "_ProbeResult":
    """Return the result of a probe of what has this identity, remembered or new.

    Args:
        identity: a name that changes whenever its answer may.
        retry_failed: whether a remembered problem is probed again: its cause may be fixed.
    """
    memory = cache_folder("probes.json")
    known: dict[str, tuple[str, str]] = {}
    with contextlib.suppress(OSError, TrilightError):  # none yet, or damaged: probed again
        known = read_json(memory.read_bytes(), dict[str, tuple[str, str]], str(memory))
    if last := known.pop(identity, None):
        problem, denoiser_problem = last
        if not (problem and retry_failed):
            return _ProbeResult(problem=problem, denoiser_problem=denoiser_problem)
    probed = _probe(variant)
    if not (probed.problem and retry_failed):
        known[identity] = (probed.problem, probed.denoiser_problem)
        newest = dict(list(known.items())[-_REMEMBERED_TRIES:])
        with contextlib.suppress(TrilightError):  # remembered next time, or probed again
            write_atomically(memory, json.dumps(newest).encode())
    return probed


def _identity(library: Path) -> str:
    """Return a name that changes whenever the library or Mitsuba does."""
    status = library.stat()
    versions = map(_version, ("mitsuba", "drjit"))
    return sha256_hex(canonical_json([str(library), status.st_mtime_ns, status.st_size, *versions]))


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


def _probe(variant: Variant, walls_s: Sequence[float] = _PROBE_S) -> _ProbeResult:
    """Render a small picture in a child, and once more where it gave no answer.

    An abort, a hang or a wrong picture is a problem.
    """
    wall_s, *more_s = walls_s
    with tempfile.TemporaryDirectory() as kernels:
        environment = {**child_environment(), "DRJIT_CACHE_DIR": kernels}
        if variant.libllvm:
            environment["DRJIT_LIBLLVM_PATH"] = variant.libllvm
        try:
            result = run_probe(variant.name, wall_s, environment)
        except subprocess.TimeoutExpired:
            silent = _ProbeResult(problem=f"no answer within {wall_s:g} s", is_silent=True)
            return _probe(variant, more_s) if more_s else silent
    if _RAYS_LEFT_OUT in result.stderr:
        return _ProbeResult(problem="Dr.Jit left out some of the rays")
    if result.returncode == 0:
        return _ProbeResult(denoiser_problem=result.stdout.strip())
    lines = result.stderr.strip().splitlines()
    return _ProbeResult(problem=lines[-1] if lines else f"it ended with status {result.returncode}")


def run_probe(
    argument: str, wall_s: float, environment: Mapping[str, str]
) -> subprocess.CompletedProcess[str]:
    """Run `variant_probe` in a child; raises TimeoutExpired after so many seconds."""
    return subprocess.run(
        [sys.executable, "-m", f"{__package__}.variant_probe", argument],
        cwd=IMPORT_ROOT,
        env=environment,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=wall_s,
        check=False,
    )


_FOLDERS = (
    "/usr/lib",
    "/usr/lib/*-linux-gnu",
    "/usr/lib/llvm*/lib",
    "/usr/lib/llvm/*/lib*",
    "/usr/lib64",
    "/usr/lib64/llvm*/lib*",
    "/usr/local/lib*",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
_NAME = re.compile(r"libLLVM(?:-(\d+))?(?:\.so|\.dylib)?(?:\.(\d+))?[\d.]*(?:\.so|\.dylib)?[\d.]*$")
_WHEEL = "karellen-llvm-core"


def llvm_libraries() -> list[Path]:
    """Return what may be LLVM: DRJIT_LIBLLVM_PATH, the wheel's, the others by falling version.

    Symbolic links are resolved, so that one library is named once.
    """
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    candidates = {
        path.resolve()
        for pattern in _FOLDERS
        for path in Path("/").glob(f"{pattern[1:]}/libLLVM*")
        if _NAME.match(path.name)
    }
    ordered = sorted(candidates, key=lambda path: (-_version_in_name(path), str(path)))
    first = [Path(named).resolve()] if named else []
    return [path for path in dict.fromkeys([*first, *_of_wheel(), *ordered]) if path.is_file()]


def _version_in_name(path: Path) -> int:
    match = _NAME.match(path.name)
    return next((int(group) for group in match.groups() if group), 0) if match else 0


def _of_wheel() -> list[Path]:
    """Return the library of the wheel: with it, no picture depends on the distribution's LLVM."""
    try:
        members = metadata.files(_WHEEL) or []
    except metadata.PackageNotFoundError:
        return []
    return [Path(str(file.locate())).resolve() for file in members if _NAME.match(file.name)]


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


_DRIVER = Path("/proc/driver/nvidia")
_ASK_S = 20


def visible_gpus() -> tuple[str, ...]:
    """Return the GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return tuple(name.strip() for name in named.split(",") if name.strip() not in ("", "-1"))
    try:
        return tuple(str(number) for number in range(len(list((_DRIVER / "gpus").iterdir()))))
    except OSError:  # a container without that folder
        return tuple(query_gpus("index"))


def gpu_identity() -> tuple[str, ...]:
    """Return texts that change with the driver, the GPUs, or those that are visible."""
    paths = (_DRIVER / "version", *sorted((_DRIVER / "gpus").glob("*/information")))
    try:
        texts = [path.read_text(errors="replace") for path in paths]
    except OSError:
        texts = query_gpus("name,driver_version")
    return (*visible_gpus(), *texts)


def gpu_memory_bytes() -> int:
    """Return the memory of the smallest GPU of this machine; 0 where it is unknown."""
    try:
        return min(int(line) for line in query_gpus("memory.total")) << 20
    except ValueError:
        return 0


def query_gpus(fields: str) -> list[str]:
    """Return a line for each GPU with fields of nvidia-smi; none where it does not answer."""
    command = ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader,nounits"]
    try:
        answer = subprocess.run(
            command, capture_output=True, text=True, timeout=_ASK_S, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    return [line.strip() for line in answer.splitlines() if line.strip()]

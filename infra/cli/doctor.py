"""`trilight doctor`: checks this machine: what is missing, its consequence, and what fixes it."""

import importlib.util
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Literal

from rich.table import Table
from rich.text import Text

from infra.cli.console import console, first_words, print_json
from infra.cli.options import command
from pipeline.isolation.confinement import VARIABLE, confinement_mode, missing_features
from pipeline.isolation.system_calls import landlock_version, seccomp_works
from pipeline.renders.mitsuba_variant import choose_variant, query_gpus
from pipeline.renders.variant_probe import VIEW_PX, VIEW_SPP, render_facts
from storage.cache import cache_folder
from storage.errors import EnvironmentFailure, TrilightError
from storage.installation import IMPORT_ROOT, child_environment, module_name
from storage.machine import available_cores, free_memory
from storage.settings.described import checked

State = Literal["ok", "slower", "missing"]

_PROBE_S = 120
_APT = "apt-get install"
_MIN_FREE_BYTES = 5 << 30

_LEAST_LIMITS = {
    "open files (ulimit -n)": (resource.RLIMIT_NOFILE, 1, 64),
    "KiB of address space (ulimit -v)": (resource.RLIMIT_AS, 1024, 2 << 30),
    "KiB of a file (ulimit -f)": (resource.RLIMIT_FSIZE, 1024, 1 << 30),
}
"""Resource, unit and least value of each limit that a run needs, by name."""


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    state: State
    """`ok`; `slower` if work goes on without it; `missing` if some work cannot be done."""
    found: str
    """Detected version, size or problem."""
    consequence: str = ""
    """Slower or impossible work; empty if the state is ok."""
    mend: str = ""
    """Command or action that fixes it; empty if none is known."""
    name: str = ""
    """Name of the check, a key of CHECKS; `examine` fills it in."""


def examine(looking_at: Callable[[str], None] = lambda name: None) -> Iterator[Finding]:
    """Yield the result of each check; probes that may crash run in child processes.

    Args:
        looking_at: callback with the name of the next check, which may take seconds.
    """
    for name, check in CHECKS.items():
        looking_at(name)
        try:
            finding = check()
        except TrilightError as error:  # its message names the next step
            finding = Finding("missing", str(error))
        except (metadata.PackageNotFoundError, ModuleNotFoundError) as error:
            text = f"no package {error.name}"
            finding = Finding("missing", text, "what needs it fails", "make setup")
        yield replace(finding, name=name)


def _machine() -> Finding:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    free = (free_memory() or 0) / 2**30
    return Finding(
        "ok",
        f"{available_cores()} of {os.cpu_count()} cores, {free:.0f} of {memory:.0f} GiB free, "
        f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    )


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    text = f"{free / 2**30:.0f} GiB free here"
    if free >= _MIN_FREE_BYTES:
        return Finding("ok", text)
    problem = "a dataset of ten thousand scenes takes more"
    return Finding("slower", text, problem, "choose another disk with --out")


def _limits() -> Finding:
    """Check the resource limits that a shell, a scheduler or a service sets."""
    problems = []
    try:
        with tempfile.TemporaryFile():
            pass
    except OSError as error:
        problems.append(f"no temporary folder ({error})")
    for name, (kind, unit, least) in _LEAST_LIMITS.items():
        soft = resource.getrlimit(kind)[0]
        if soft != resource.RLIM_INFINITY and soft < least:
            problems.append(f"{soft // unit} {name}; expected at least {least // unit}")
    if not problems:
        return Finding("ok", "none that would stop a run")
    return Finding(
        "missing",
        "; ".join(problems),
        consequence="children cannot start, or are ended",
        mend="raise the limit where it is set (ulimit -a lists them); TMPDIR=/a/writable/folder",
    )


def _renderer() -> Finding:
    cache_folder("")  # raises where there is neither a cache nor a home
    text = f"mitsuba {metadata.version('mitsuba')}"
    code = f"import {module_name('pipeline.renders')}, mitsuba; mitsuba.set_variant('scalar_rgb')"
    finding = _probe(code, text, "nothing can be rendered", f"{_APT} libatomic1")
    if finding.state == "missing":
        return finding
    try:
        variant = choose_variant("auto")
    except EnvironmentFailure:
        raise
    except TrilightError as error:
        mend = "pip install karellen-llvm-core"
        return Finding("missing", str(error), "nothing can be rendered", mend)
    return Finding("ok", ", ".join(filter(None, (text, variant.name, variant.libllvm))))


def _denoiser() -> Finding:
    variant = choose_variant("auto")
    facts = render_facts(variant)
    if not facts:
        text = f"pyoidn {metadata.version('pyoidn')} does not respond"
        return Finding("missing", text, "pictures cannot be denoised", "make setup")
    text = (
        f"OIDN {facts['denoiser']}, {facts['denoiser_device']}, {facts['threads']} threads; a view "
        f"of {VIEW_PX} pixels and {VIEW_SPP} samples takes {facts['view_s']} s"
    )
    if not variant.note:
        return Finding("ok", text)
    mend = "a newer driver, or a card from compute capability 7.5 on"
    return Finding("slower", text, variant.note, mend)


def _mesh_decimation() -> Finding:
    code = f"import {module_name('pipeline.assets.decimation.meshopt')}"
    problem = "meshes cannot be decimated where pymeshlab fails"
    return _probe(code, f"wasmtime {metadata.version('wasmtime')}", problem, "make setup")


def _mesh_filters() -> Finding:
    if importlib.util.find_spec("pymeshlab") is None:
        problem = "libigl decimates: other meshes, other digests, and no profile uniform"
        return Finding("slower", "no pymeshlab (GPL)", problem, "make setup")
    code = (
        f"from {module_name('pipeline.assets.recipe')} import missing_filters; "
        "m = missing_filters(); "
        "raise SystemExit(', '.join(m) if m else 0)"
    )
    text = f"pymeshlab {metadata.version('pymeshlab')}"
    return _probe(code, text, "no mesh can be made by pymeshlab", f"{_APT} libgl1 libopengl0")


def _confinement() -> Finding:
    mode = confinement_mode()
    version = landlock_version()
    has = [f"Landlock {version}"] if version else []
    text = ", ".join([*has, *(["seccomp"] if seccomp_works() else [])]) or "nothing to confine by"
    if mode != "off" and not missing_features():
        return Finding("ok", text)
    mend = "run on Linux 5.13 or later, or read strangers' files in a container"
    if mode == "off":
        text = f"{text}; {VARIABLE}=off"
        mend = f"unset {VARIABLE}"
    problem = "a file that takes over its parser can do all that you can"
    return Finding("missing" if mode == "required" else "slower", text, problem, mend)


def _orchestrator() -> Finding:
    cache_folder("")  # as the renderer
    code = (
        f"from {module_name('pipeline.flows.prefect_server')} import load_prefect; "
        "load_prefect(); import prefect.server.api.server"
    )
    text = f"prefect {metadata.version('prefect')}, fastapi {metadata.version('fastapi')}"
    return _probe(code, text, "no flow can run", "make setup")


def _learning() -> Finding:
    if importlib.util.find_spec("torch") is None:
        problem = "data can be made, but nothing can be trained"
        return Finding("missing", "no torch", problem, "make setup-all")
    return Finding("ok", f"torch {metadata.version('torch')}")


def _accelerator() -> Finding:
    rows = query_gpus("name,driver_version")
    if not rows:
        problem = "rendering and training use the processor"
        return Finding("slower", "none", problem, "run on a machine with an NVIDIA GPU")
    text = "; ".join(row.replace(", ", ", driver ") for row in rows)
    try:
        choose_variant(device="gpu")
    except TrilightError as error:
        mend = "a driver with OptiX; in a container NVIDIA_DRIVER_CAPABILITIES=all"
        return Finding("slower", f"{text}; {error}", "rendering uses the processor", mend)
    return Finding("ok", f"{text}; renders with the driver's OptiX")


def _cache() -> Finding:
    folder = cache_folder("")
    existing = next(place for place in [folder, *folder.parents] if place.exists())
    if os.access(existing, os.W_OK):
        return Finding("ok", str(folder))
    return Finding(
        "missing",
        f"{folder} cannot be written",
        consequence="the orchestrator cannot store its records",
        mend="export TRILIGHT_CACHE=/a/writable/folder",
    )


def _probe(code: str, text: str, consequence: str, mend: str) -> Finding:
    """Run code in a child process; a non-zero status, a crash or a hang is `missing`."""
    try:
        result = subprocess.run(
            [sys.executable, "-c", code],
            cwd=IMPORT_ROOT,
            env=child_environment(),
            capture_output=True,
            text=True,
            timeout=_PROBE_S,
            check=False,
        )
        status = result.returncode
        last = [f"ended with status {status}", *result.stderr.strip().splitlines()][-1]
        problem = last if status else ""
    except subprocess.TimeoutExpired:
        problem = f"no answer within {_PROBE_S} s"
    except OSError as error:
        problem = f"{sys.executable} cannot be started ({error.strerror})"
    if not problem:
        return Finding("ok", text)
    return Finding("missing", f"{text}: {problem}", consequence, mend)


CHECKS: Mapping[str, Callable[[], Finding]] = {
    "machine": _machine,
    "disk": _disk,
    "limits": _limits,
    "cache": _cache,
    "renderer": _renderer,
    "denoiser": _denoiser,
    "mesh filters": _mesh_filters,
    "mesh decimation": _mesh_decimation,
    "confinement": _confinement,
    "orchestrator": _orchestrator,
    "learning": _learning,
    "GPU": _accelerator,
}
"""Checks of `examine` by name, in the order of the report."""


_STYLES = {"ok": "green", "slower": "yellow", "missing": "red"}
_WIDTHS = (7, 16)
"""Widths of the columns state and name; fixed, because rows are printed one by one."""


@checked()
class DoctorOptions:
    """Checks."""

    measure: bool = False
    """Time previews too, for render --seconds and --error: half a minute."""


@command()
def doctor(options: DoctorOptions) -> None:
    first_words("Looking at this machine")
    findings = []
    with console.status("") as status:
        for finding in examine(lambda name: status.update(f"looking at: {name}")):
            findings.append(finding)
            console.print(_row(finding))
    if options.measure:
        from infra.render.machine_costs import measure_costs
        from infra.render.preview_table import keep_machine_costs, shipped_table

        with console.status("measuring previews"):
            path = keep_machine_costs(measure_costs(shipped_table()))
        findings.append(Finding("ok", f"measured, and kept in {path}", name="previews"))
        console.print(_row(findings[-1]))
    print_json([asdict(finding) for finding in findings])
    if any(finding.state == "missing" for finding in findings):
        sys.exit(1)


def _row(finding: Finding) -> Table:
    text = Text(finding.found)
    if finding.consequence:
        text.append(f"\n{finding.consequence}; fix: {finding.mend}", "yellow")
    row = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for width in _WIDTHS:
        row.add_column(width=width)
    row.add_column()
    row.add_row(Text(finding.state, _STYLES[finding.state]), finding.name, text)
    return row

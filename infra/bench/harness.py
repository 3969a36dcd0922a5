"""The one way to measure: warm up, alternate the sides, repeat, and say on what machine.

Machines drift. The sides of a comparison therefore take turns (A B A B ...), each figure is given
as median with smallest and largest, and only ratios within one run are claims.
"""

import datetime
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "bench"

_LIBRARIES = (
    "trilight",
    "mitsuba",
    "drjit",
    "pyoidn",
    "numpy",
    "torch",
    "pymeshlab",
    "meshoptimizer",
    "libigl",
    "OpenEXR",
    "h5py",
)


@dataclass(frozen=True, kw_only=True)
class Options:
    """What the user says of a benchmark."""

    quick: bool
    """Minutes instead of a careful measurement."""
    objects: tuple[str, ...]
    """Sources of objects."""
    allowed_licences: tuple[str, ...]
    """Of objects that may be measured."""
    scenes: Path | None = None
    """Folder of RenderFormer scene files that belong to the named set as well."""
    cycles_spp: tuple[int, ...] = ()
    """Samples at which Blender's Cycles takes part; Blender is installed for it."""
    usd_per_core_hour: float = 0.04
    """What computing costs."""
    resume: bool = False
    """Keep what an interrupted run of the same plan has measured."""
    knobs: tuple[str, ...] = ()
    """Of `trade`: these alone."""
    checkpoint: str = "builtin:"
    """Network, the shipped one by default, that `trade` compares with the path tracer."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """One figure over the counted repeats."""

    median: float
    """What to quote."""
    low: float
    """The smallest."""
    high: float
    """The largest."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What every benchmark says besides its figures."""

    name: str
    """Name of the benchmark."""
    machine: Mapping[str, Any] = field(default_factory=lambda: machine())
    """Processor, cores, system, versions, revision."""
    date: str = field(default_factory=lambda: datetime.date.today().isoformat())
    """When."""

    def as_json_line(self) -> str:
        """Return the result as one line."""
        return json.dumps(asdict(self), sort_keys=True)


@dataclass(frozen=True, kw_only=True)
class Comparison(Result):
    """The figures of every side, with what they were measured on."""

    sides: Mapping[str, Mapping[str, Spread]]
    """Figures by side; `seconds` is always one of them."""
    repeats: int
    """Counted rounds, after one that was not counted."""


def compare(
    name: str,
    sides: Mapping[str, Callable[[], Mapping[str, float]]],
    *,
    repeats: int,
    round_done: Callable[[], None] = lambda: None,
) -> Comparison:
    """Measure the sides in turns, after one round that is not counted.

    Args:
        name: name of the benchmark.
        sides: what to run; each returns its further figures, and its wall time is `seconds`.
        repeats: counted rounds.
        round_done: called after every run of every side.
    """
    figures: dict[str, list[Mapping[str, float]]] = {side: [] for side in sides}
    for counted in [False] + [True] * repeats:
        for side, run in sides.items():
            started = time.perf_counter()
            found = run()
            seconds = time.perf_counter() - started
            if counted:
                figures[side].append({"seconds": seconds, **found})
            round_done()
    return Comparison(
        name=name,
        sides={side: _spreads(rounds) for side, rounds in figures.items()},
        repeats=repeats,
    )


def _spreads(rounds: Sequence[Mapping[str, float]]) -> dict[str, Spread]:
    return {
        name: Spread(
            median=float(np.median(values)), low=float(min(values)), high=float(max(values))
        )
        for name in rounds[0]
        if (values := [found[name] for found in rounds])
    }


def machine() -> dict[str, Any]:
    """Return what a figure depends on: processor, cores, system, libraries, revision."""
    versions = {}
    for library in _LIBRARIES:
        try:
            versions[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": versions,
        "revision": _revision(),
    }


def save(result: Result, *, quick: bool) -> Path:
    """Write the result as dated JSON under docs/bench and return its path."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    suffix = "-quick" if quick else ""
    path = RESULTS / f"{result.name}{suffix}-{result.date}.json"
    path.write_text(result.as_json_line() + "\n")
    return path


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _revision() -> str:
    result = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return result.stdout.strip() or "unknown"

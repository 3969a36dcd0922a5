"""What commands cost on datasets of a hundred to a quarter of a million shards.

The datasets are simulated (infra.bench.subjects.simulated_set). Commands that only read what says
what a dataset is run on one of eight scenes a shard, whose shards are holes: 250,000 of them stand
for the paper's two million scenes. Those that read scenes run on whole shards of one scene each.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, TurnFigures
from infra.bench.growth import fitted_exponent
from infra.bench.sides.sized_commands import COMMANDS, measured
from infra.bench.subjects.simulated_set import write_outline, write_whole
from infra.bench.workshop import Workshop

SIZES: Mapping[str, tuple[int, ...]] = {
    "quick": (100, 1_000),
    "careful": (100, 1_000, 10_000, 250_000),
}
"""Shards."""
_MOST_WHOLE = 10_000
"""Shards of the largest dataset of whole ones: a quarter of a million would take hours."""
_SMALL, _OTHER = 10, 1_000_000
"""Shards of the dataset that a process warms up on; number of the first scene of another one."""
_WRITERS: Mapping[str, Callable[[Path, int], None]] = {
    "outline": write_outline,
    "whole": write_whole,
}
_EXPONENTS = {"core_s": "core_exponent", "peak_bytes": "peak_exponent"}


def _points(effort: Effort) -> list[Point]:
    return [
        Point(name=f"{command}, {size:,} shards", settings=(command, size))
        for command in COMMANDS
        for size in SIZES[effort.name]
        if COMMANDS[command].of != "whole" or size <= _MOST_WHOLE
    ]


def _growth(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    """Measure command by command; the largest size of each also has the exponents."""
    for command, sized in COMMANDS.items():
        sizes = sorted(point.settings[1] for point in points if point.settings[0] == command)
        found: dict[int, Figures] = {}
        for size in sizes:
            root, small = _set(workshop, sized.of, size), _set(workshop, sized.of, _SMALL)
            found[size] = measured(command, root, small)
        exponents = {
            name: fitted_exponent(list(found), [each[of] for each in found.values()])
            for of, name in _EXPONENTS.items()
        }
        for size, figures in found.items():
            last = exponents if size == max(sizes) else {}
            yield f"{command}, {size:,} shards", {**figures, **last}


def _set(workshop: Workshop, of: str, size: int) -> Path:
    """Return a dataset of a kind and size; those of one kind and another one lie side by side."""

    def made() -> Path:
        folder: Path = workshop.kept("folder", workshop.folder)
        root = folder / of / f"{size}"
        root.mkdir(parents=True)
        _WRITERS[of](root, size)
        other = root.with_name("other")
        if of == "whole" and not other.exists():
            write_whole(other, _SMALL, first=_OTHER)
        return root

    if of == "whole":  # nothing needs those any more
        shutil.rmtree(workshop.kept("folder", workshop.folder) / "outline", ignore_errors=True)
    return workshop.kept((of, size), made)


def _mega(value: float) -> float:
    return value / 1e6


EXPERIMENTS = (
    Experiment(
        name="at-size",
        title="Commands against the size of the dataset",
        about=(
            "Simulated datasets of 100 to 250,000 shards: core-seconds, memory and bytes read of "
            "each command in a warm process. Eight scenes of four views a shard, so two million "
            "scenes, where no scene is read; one scene a shard where they are."
        ),
        cost=Column(name="core-seconds", figure="core_s"),
        columns=(
            Column(name="MB at most", figure="peak_bytes", then=_mega),
            Column(name="MB read", figure="read_bytes", then=_mega),
            Column(name="core-seconds grow as n^", figure="core_exponent"),
            Column(name="memory grows as n^", figure="peak_exponent"),
        ),
        also_cost=("MB at most", "MB read"),
        size_of=lambda point: (point.name.rpartition(", ")[0], float(_shards(point))),
        against_size="shards",
        points=_points,
        turns=lambda effort: ["round 1"],
        measure=_growth,
        needs=("torch",),
    ),
)


def _shards(point: Point) -> int:
    return int(point.name.rpartition(", ")[2].split()[0].replace(",", ""))

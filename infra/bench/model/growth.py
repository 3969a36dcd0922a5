"""How seconds and memory of our network grow with triangles, views and pixels, one at a time."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib
import torch

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench.harness import Comparison, Options, Spread, compare
from infra.bench.model.cases import device, side_name, timed_forward, with_figures
from infra.bench.model.contenders import DEFAULT, EQUAL, Contenders, Forward
from infra.bench.model.memory import peaks_of
from infra.bench.model.workloads import label
from infra.bench.renders.log_axis import plain_log
from model.costs import Workload
from model.published.config import PublishedConfig, decode_published

NAME = "model-growth"
SIDES = (EQUAL, DEFAULT)
AXES = {"triangles": "triangles", "views": "views", "resolution": "pixels across"}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured."""

    config: PublishedConfig
    """The network."""
    middle: Workload
    """Of which one number at a time is changed."""
    values: Mapping[str, tuple[int, ...]]
    """What each is changed to."""
    repeats: int
    """Counted rounds."""

    def along(self, axis: str) -> list[Workload]:
        """Return the workloads of one curve."""
        fields = vars(self.middle)
        return [Workload(**{**fields, axis: value}) for value in self.values[axis]]

    def workloads(self) -> list[Workload]:
        """Return each once."""
        return list(dict.fromkeys(one for axis in AXES for one in self.along(axis)))


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure Base; quickly up to 4096 triangles, 4 views and 256 pixels, otherwise all."""
    return measure(_plan(options), device(), round_done)


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return rounds_of(_plan(options))


def rounds_of(plan: Plan) -> int:
    """Return how often `measure` calls `round_done`."""
    return len(SIDES) * (len(plan.workloads()) * (1 + plan.repeats) + 1)


def _plan(options: Options) -> Plan:
    quick = options.quick
    return Plan(
        config=decode_published({}),
        middle=Workload(triangles=1536, views=1, resolution=256),
        values={
            "triangles": (512, 1536, 4096) if quick else (512, 1024, 2048, 4096, 8192, 16384),
            "views": (1, 2, 4) if quick else (1, 2, 4, 8, 16),
            "resolution": (128, 256) if quick else (128, 192, 256, 384, 512),
        },
        repeats=1,  # neighbours on a curve bear each other out
    )


def measure(plan: Plan, on: torch.device, round_done: Callable[[], None]) -> Comparison:
    """Return seconds and memory of every workload."""
    contenders = Contenders(plan.config, SIDES, on)
    sides = {
        side_name(label(workload), side): partial(_seconds, contenders.prepared(side, workload), on)
        for workload in plan.workloads()
        for side in SIDES
    }
    timed = compare(NAME, sides, repeats=plan.repeats, round_done=round_done)
    further = {}
    for side in SIDES:
        peaks = peaks_of(side, plan.config, plan.workloads(), on)
        for workload, peak in zip(plan.workloads(), peaks, strict=True):
            found = {
                "memory_bytes": float(peak),
                **{k: float(v) for k, v in vars(workload).items()},
            }
            further[side_name(label(workload), side)] = found
        round_done()
    return with_figures(timed, further)


def _seconds(forward: Forward, on: torch.device) -> Mapping[str, float]:
    return timed_forward(forward, on)[1]


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    return [
        (
            name,
            f"{figures['seconds'].median:.2f} s, {figures['core_s'].median:.2f} core-s, "
            f"{figures['memory_bytes'].median / 1e6:.0f} MB beyond the weights",
        )
        for name, figures in result.sides.items()
    ]


def plot(result: Comparison, path: Path) -> None:
    """Draw core-seconds above and memory below, along each of the three."""
    figure, grid = plt.subplots(2, len(AXES), figsize=(11, 6), layout="constrained", sharey="row")
    for column, (axis, words) in enumerate(AXES.items()):
        for side in SIDES:
            curve = _curve(result, axis, side)
            x = [one[axis].median for one in curve]
            for panel, name, unit in ((grid[0], "core_s", 1), (grid[1], "memory_bytes", 1e6)):
                panel[column].plot(x, [one[name].median / unit for one in curve], "o-", label=side)
        for panel in grid[:, column]:
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.set_xlabel(words)
            panel.grid(alpha=0.3)
            panel.xaxis.set_minor_locator(plt.NullLocator())
            panel.set_xticks(x, [f"{value:.0f}" for value in x], rotation=40)
            plain_log(panel.yaxis)
    grid[0, 0].set_ylabel("core-seconds")
    grid[1, 0].set_ylabel("MB beyond the weights")
    grid[0, 0].legend()
    figure.suptitle(f"The rest: {_rest(result)}; {result.date}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _curve(result: Comparison, axis: str, side: str) -> list[Mapping[str, Spread]]:
    """Return the figures of a side along an axis: where the other two are in the middle."""
    found = [figures for name, figures in result.sides.items() if name.endswith(f": {side}")]
    middle = _middle(result)
    others = [name for name in AXES if name != axis]
    along = [one for one in found if all(one[other].median == middle[other] for other in others)]
    return sorted(along, key=lambda one: one[axis].median)


def _middle(result: Comparison) -> dict[str, float]:
    """Return the value of each that most workloads have."""
    middle = {}
    for axis in AXES:
        values = [figures[axis].median for figures in result.sides.values()]
        middle[axis] = max(set(values), key=values.count)
    return middle


def _rest(result: Comparison) -> str:
    middle = _middle(result)
    return label(Workload(**{axis: int(value) for axis, value in middle.items()}))

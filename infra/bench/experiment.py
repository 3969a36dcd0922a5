"""Experiments: their points with what measures them, and the columns of their table.

No heavy library is imported here: the list of experiments is made without measuring anything.

A results file holds the runs of one experiment, a JSON line for each point and trial, so that a
killed run resumes. The first line of a run is its plan with machine, commit and date, its last line
is the end; an incomplete line of a killed run is cut off.
"""

import dataclasses
import datetime
import importlib
import importlib.util
import json
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from infra.bench_options import BenchOptions
from storage.atomic import append_line
from storage.errors import TrilightError
from storage.typed_json import read_json_lines

if TYPE_CHECKING:
    from infra.bench.context import BenchContext

Figures = Mapping[str, float]
"""Measured numbers of one point in one trial, by name."""

Over = Literal["median", "mean", "least", "most", "p5", "low", "high", "pair"]
"""Reduction of the figures of all trials to one number. `low` and `high` are the ends of the mean's
95 % interval, bootstrapped over clusters of trials. `pair` is the mean of the differences to the
point's rival, trial by trial, with its interval."""


@dataclass(frozen=True, kw_only=True)
class BenchScale:
    """Amount of measurement, from which experiments derive their points and trials."""

    name: str
    """Name of the scale, `quick` or `full`."""
    scenes: int
    """Number of scenes of the experiments on pictures."""
    resolution: int
    """Width of those pictures in pixels, a divisor of 256."""
    max_spp: int
    """Maximum number of samples per pixel; a multiple of 128."""
    reference_spp: int
    """Samples per pixel of references at 256 pixels."""
    picture_px: int
    """Width of pictures where whole samples are made, in pixels."""
    objects: int
    repeats: int
    """Number of measured rounds of the same work."""
    steps: int
    """Steps of each paired training, and of each preset on the GPU."""
    held_out: int
    """Number of scenes on which paired trainings are evaluated."""
    growth: int
    """Number of sizes that growth is measured at, each four times the one before."""
    layouts: int
    """Number of layouts of the calibration."""


FULL = BenchScale(
    name="full", scenes=20, resolution=128, max_spp=1024, reference_spp=512, picture_px=256,
    objects=24, repeats=3, steps=2000, held_out=64, growth=5, layouts=400,
)  # fmt: skip
QUICK = BenchScale(
    name="quick", scenes=3, resolution=64, max_spp=256, reference_spp=128, picture_px=128,
    objects=5, repeats=1, steps=100, held_out=16, growth=3, layouts=2,
)  # fmt: skip


def device_of(options: BenchOptions) -> str:
    """Return the device of the options, or the one that torch finds."""
    if options.device:
        return options.device
    if importlib.util.find_spec("torch") is None:
        return "cpu"
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


@dataclass(frozen=True)
class Column:
    """Column of the table: a figure of every trial, reduced to one number."""

    name: str
    """Heading of the column, with the unit."""
    figure: str
    """Name of the figure among those that a trial returns."""
    over: Over = "median"
    """Reduction of the figures of all trials to one number."""
    then: Callable[[float], float] = float
    """Conversion of that number, such as `3600 / seconds`; by default it stays as it is."""


Measure = Callable[["BenchContext", str], Figures]
"""Function that measures a point in one trial. It raises `Rejected` or `ChildFailed` if the trial's
scene or object is unusable; the trial then counts for no point."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """Measured setting, a row of the table; the results hold all fields but `measure`."""

    name: str
    measure: Measure | None = field(default=None, repr=False)
    """Function that measures it; None of a point that was read from results."""
    default: bool = False
    """True for the default of the product."""
    judged: bool = True
    """True for a choice; False for a yardstick, such as a picture's own noise."""
    group: str = ""
    """Group of points that are compared: they share a panel of the plot and a Pareto front."""
    kind: str = ""
    """Name of its color in the plot; by default all have one."""
    rival: str | None = None
    """Name of the point that columns over `pair` take the difference to; None of the rival."""
    size: float | None = None
    """Size against which the costs are plotted; None without one."""

    def record(self) -> dict[str, Any]:
        """Return the fields for the results as JSON values."""
        return {name: value for name, value in vars(self).items() if name != "measure"}


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """Experiment: points that are measured together, trial by trial."""

    name: str
    title: str
    cost: Column
    """First column of the table; above 0."""
    points: Callable[[BenchScale, BenchOptions], Sequence[Point]]
    """Function that returns the points, in the order of the table."""
    trials: Callable[[BenchScale, BenchOptions], Sequence[str]]
    """Scenes, objects or repeats: in each trial every point is measured once."""
    error: Column | None = None
    """Second column of the table; None if only costs are compared."""
    better: Literal["higher", "lower"] = "lower"
    """Direction in which the error is better: decibels are higher where pictures agree."""
    columns: tuple[Column, ...] = ()
    also_cost: tuple[str, ...] = ()
    """Further columns that count as costs: a point cheaper in any of them is not dominated."""
    because: str = ""
    """Meaning of the figures, for the reader of the table."""
    cluster: Callable[[str], str] = str
    """Name of a trial's cluster: trials of one cluster are alike; by default none is."""
    figures: tuple[str, ...] = ()
    """Names of the figures, where rows hold their values alone; a trial may lack all of them."""
    versions: Callable[[BenchOptions], Mapping[str, str]] | None = None
    """Function that returns all that figures depend on, where a run may resume on other machines
    and commits; None where figures are of one machine, one commit and all options."""
    needs: tuple[Literal["torch", "blender", "data"], ...] = ()
    """Requirements on the machine or the options."""


def percent(fraction: float) -> float:
    """Return a fraction in per cent, for `Column.then`."""
    return 100 * fraction


def rounds(scale: BenchScale, options: BenchOptions) -> tuple[str, ...]:
    """Return the trials of an experiment that repeats the same measurement."""
    return tuple(f"round {number}" for number in range(1, scale.repeats + 1))


def columns_of(experiment: Experiment) -> tuple[Column, ...]:
    """Return the columns of a table: cost, error where there is one, and the further ones."""
    error = (experiment.error,) if experiment.error else ()
    return (experiment.cost, *error, *experiment.columns)


def public_options(options: BenchOptions) -> dict[str, Any]:
    """Return the options as JSON values that name no folder of this machine."""
    from infra.render.methods import network_labels
    from storage.digests import sha256_hex

    values = dataclasses.asdict(options)
    values["scenes"] = options.scenes.name if options.scenes else None
    values["checkpoint"] = list(network_labels(options.checkpoint))
    if options.data:
        name = options.data.rstrip("/").rpartition("/")[2]
        values["data"] = f"{name} ({sha256_hex(options.data.encode())[:8]})"
    return values


def every_experiment() -> dict[str, Experiment]:
    """Return all experiments by name, in the order of the alphabet."""
    from infra.bench import experiments

    modules = sorted(module.name for module in pkgutil.iter_modules(experiments.__path__))
    experiments_found = [
        importlib.import_module(f"{experiments.__name__}.{name}").EXPERIMENT for name in modules
    ]
    return {one.name: one for one in experiments_found}


def experiment_of(name: str) -> Experiment:
    """Return the experiment of a name.

    Raises:
        TrilightError: the name is unknown; the message has all that exist.
    """
    known = every_experiment()
    if name not in known:
        raise TrilightError(f"experiment {name!r} is unknown; expected one of {', '.join(known)}.")
    return known[name]


@dataclass(kw_only=True)
class Run:
    """Run of an experiment, finished or not; what is added is in its file at once."""

    path: Path
    """File with the runs of one experiment."""
    plan: Mapping[str, Any]
    """Everything that its figures depend on: points, trials, scale, options, machine."""
    date: str
    """Day of its start, such as 2026-11-22."""
    trials: dict[str, dict[str, Figures]] = field(default_factory=dict)
    """Figures by trial and point."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Reason by trial of trials that count for no point."""
    notes: list[str] = field(default_factory=list)
    """Remarks on the result, such as the network's name."""
    seconds: float | None = None
    """Wall-clock seconds since the run last resumed; None for an unfinished run."""

    def whole_trials(self) -> list[str]:
        """Return the trials that have every point of the plan."""
        points = {point["name"] for point in self.plan["points"]}
        return [trial for trial in self.plan["trials"] if points <= set(self.trials.get(trial, {}))]

    def missing_trials(self) -> list[str]:
        """Return the trials that are not measured yet."""
        done = {*self.whole_trials(), *self.left_out}
        return [trial for trial in self.plan["trials"] if trial not in done]

    def take(self, record: Mapping[str, Any]) -> None:
        """Receive a record of the file after the plan."""
        if "figures" in record:
            figures = record["figures"]
            if isinstance(figures, list):
                figures = dict(zip(self.plan["figures"], figures, strict=bool(figures)))
            self.trials.setdefault(record["trial"], {})[record["point"]] = figures
        elif "left_out" in record:
            self.left_out[record["trial"]] = record["left_out"]
        else:
            self.seconds = record["seconds"]
            self.notes = record["notes"]

    def add(self, trial: str, point: str, figures: Figures) -> None:
        """Add the figures of one point in one trial; values alone if the plan names them."""
        names = self.plan.get("figures")
        stored = dict(figures) if names is None else [figures[name] for name in names if figures]
        self.write(trial=trial, point=point, figures=stored)

    def write(self, **record: Any) -> None:
        """Add a record: why a trial counts for no point, or that the run has ended."""
        _append(self.path, record)
        self.take(record)


def read_runs(path: Path) -> list[Run]:
    """Return all runs of a file, oldest first; empty without a file.

    Raises:
        TrilightError: the file holds no runs.
    """
    data = path.read_bytes() if path.is_file() else b""
    runs: list[Run] = []
    try:
        for record in read_json_lines(data, dict[str, Any], str(path), torn_end=True):
            if "plan" in record:
                runs.append(Run(path=path, plan=record["plan"], date=record["date"]))
            else:
                runs[-1].take(record)
    except (ValueError, LookupError, TypeError) as error:
        raise TrilightError(
            f"{path}: no rows of `trilight bench` ({error}); expected a file that it wrote. Name "
            "another one by --out."
        ) from error
    return runs


def begin_run(path: Path, plan: Mapping[str, Any]) -> Run:
    """Return the last run of a file if it is unfinished and has this plan, else a new run."""
    plain = json.loads(json.dumps(plan))
    runs = read_runs(path)
    if runs and runs[-1].seconds is None and runs[-1].plan == plain:
        return runs[-1]
    today = datetime.date.today().isoformat()
    _append(path, {"plan": plain, "date": today})
    return Run(path=path, plan=plain, date=today)


def _append(path: Path, record: Mapping[str, Any]) -> None:
    append_line(path, json.dumps(record, sort_keys=True, allow_nan=False), durable=True)

"""`trilight bench trade`: every knob that trades cost for accuracy, in one table.

Each error says against what. Costs are core-seconds of the process that does the work, bytes, or
counts, so that other work on the machine matters little; ratios are within one run.
"""

import dataclasses
import importlib.util
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

from infra.bench.harness import Options, Result, machine
from infra.bench.renders.kept import Kept
from infra.bench.trade.curves import Curve, Knob, judged
from infra.bench.trade.engine_knob import NAME as ENGINES
from infra.bench.trade.figures import plot as plot
from infra.bench.trade.figures import shown, shown_error
from infra.bench.trade.knobs import KNOBS, knob_named
from infra.bench.trade.saved import curve_of
from infra.bench.trade.workshop import CAREFUL, QUICK, Workshop

NAME = "trade"


@dataclass(frozen=True, kw_only=True)
class Trade(Result):
    """All curves, and what was left out."""

    curves: Mapping[str, Curve]
    """By knob, in the order of the page."""
    skipped: Mapping[str, str]
    """Knobs that need what is not there: why."""
    seconds: Mapping[str, float]
    """On the clock, by knob."""


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return len(_chosen(options))


def run(options: Options, round_done: Callable[[], None]) -> Trade:
    """Measure; quickly four scenes and few samples, otherwise twelve.

    Raises:
        TrilightError: no such knob, or no such checkpoint.
    """
    chosen = _chosen(options)
    effort = QUICK if options.quick else CAREFUL
    here = machine()
    plan = {"machine": here, "asked": _asked(options), "effort": dataclasses.asdict(effort)}
    kept_name = _name(options) + ("-quick" if options.quick else "")
    kept = Kept(kept_name, plan, resume=options.resume)
    skipped, curves, seconds = {}, {}, {}
    with closing(Workshop(effort, options)) as shop:
        for knob in chosen:
            lack = _lack(knob)
            if lack:
                skipped[knob.name] = lack
            else:
                record = kept.item(knob.name, lambda knob=knob: _record(knob, shop))  # type: ignore[misc]
                curves[knob.name], seconds[knob.name] = curve_of(record), record["seconds"]
            round_done()
    kept.forget()
    return Trade(name=_name(options), machine=here, curves=curves, skipped=skipped, seconds=seconds)


def _asked(options: Options) -> dict[str, object]:
    """Return what the user says and the curves depend on; opens the network, wherever it is."""
    asked: dict[str, object] = {
        "objects": options.objects,
        "allowed_licences": options.allowed_licences,
    }
    if any(knob.name == ENGINES and not _lack(knob) for knob in _chosen(options)):
        from model.neural_renderer import NeuralRenderer

        asked["checkpoint"] = NeuralRenderer.load(options.checkpoint, device="cpu").digest
    return asked


def _record(knob: Knob, shop: Workshop) -> dict[str, object]:
    began = time.perf_counter()
    curve = knob.measure(shop)
    judged(knob, curve)  # a curve without a default ends the run before it is kept
    return {**dataclasses.asdict(curve), "seconds": time.perf_counter() - began}


def _chosen(options: Options) -> list[Knob]:
    if not options.knobs:
        return list(KNOBS)
    wanted = {knob_named(name).name for name in options.knobs}
    return [knob for knob in KNOBS if knob.name in wanted]


def _name(options: Options) -> str:
    """Return the name of the result: single knobs do not stand for the whole."""
    return "-".join([NAME, *(knob.name for knob in _chosen(options) if options.knobs)])


def _lack(knob: Knob) -> str:
    if "torch" in knob.needs and importlib.util.find_spec("torch") is None:
        return "torch is not installed; run `make setup-all`"
    return ""


def rows(result: Trade) -> list[tuple[str, str]]:
    """Return the table for people: knob and setting; cost ratio, error, whether on the front."""
    lines: list[tuple[str, str]] = []
    for name, curve in result.curves.items():
        knob = knob_named(name)
        lines.append((name, f"cost: {knob.cost}; error: {knob.error}, {knob.better} is better"))
        lines += _setting_rows(knob, curve)
    return [*lines, *((name, f"left out: {why}") for name, why in result.skipped.items())]


def _setting_rows(knob: Knob, curve: Curve) -> Sequence[tuple[str, str]]:
    words = {True: "front", False: "", None: "n/a"}
    return [
        (
            f"  {one.point.setting}",
            f"{shown(one.cost_ratio):>6} x  {shown_error(knob, one.point.error):>8}  "
            f"{words[one.on_front]:5}{'  default' if one.point.default else ''}",
        )
        for one in judged(knob, curve)
    ]

"""What is predicted of a step, to stand beside what it took."""

from collections.abc import Mapping
from typing import Any

from infra.bench.card.drawn_batch import workloads
from infra.bench.card.effort import CardEffort, sized
from model.costs import training_flops
from train.runs import named_run


def least_ms(
    run: str, scenes: int, effort: CardEffort, flops_per_s: Mapping[str, float]
) -> float | None:
    """Return the ms of a step whose products all ran at the speed of a large square one.

    No step is quicker. None where the type's speed was not measured.

    Args:
        run: name of the run.
        scenes: of its pass.
        effort: at whose size it was run.
        flops_per_s: of a large product by type (`probe.product_rates`).
    """
    settings = sized(named_run(run), effort)
    rate = flops_per_s.get(settings.precision)
    if rate is None:
        return None
    flops = sum(training_flops(settings.model, each) for each in workloads(settings, scenes))
    return 1e3 * flops / rate


def with_prediction(
    row: Mapping[str, Any], effort: CardEffort, flops_per_s: Mapping[str, float]
) -> dict[str, Any]:
    """Return the record of a run's steps with what was predicted of them."""
    if "failed" in row:
        return dict(row)
    return {**row, "least_ms": least_ms(row["run"], row["scenes"], effort, flops_per_s)}

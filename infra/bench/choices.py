"""The table `If you need this, choose that`; every figure in it comes from results."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from infra.bench.catalogue import chosen
from infra.bench.curve import Row, rows
from infra.bench.experiment import Experiment
from infra.bench.run import newest_run
from infra.bench.table import shown, shown_in
from storage.errors import TrilightError


@dataclass(frozen=True)
class Choice:
    """One row of the table."""

    need: str
    """The need, in a user's words."""
    how: str
    """What to type, or where it is said."""
    experiment: str
    """Whose points tell what it costs."""
    point: str
    """Name of its point."""
    despite: str = ""
    """Why it is advised although its point is not on the front; a test requires a reason."""


CHOICES = (
    Choice("a first look at a training, in minutes", "`--noise-floor 34`", "noise-floor", "34 dB"),
    Choice("targets for weeks of training", "`pretrain-256` as it is", "noise-floor", "46 dB"),
    Choice(
        "pictures to judge networks by",
        "`--noise-floor 50` with a high cap",
        "noise-floor",
        "50 dB",
    ),
    Choice("direct light and one bounce only", "`--set renders.max_depth=3`", "depth", "3"),
    Choice(
        "the fewest triangles for a network",
        "`--set scenes.max_triangles=768`",
        "scene-budget",
        "768 triangles",
    ),
    Choice(
        "scenes whose worst objects lose less of their shape",
        "`--set scenes.max_triangles=4096`",
        "scene-budget",
        "4096 triangles",
    ),
    Choice(
        "meshes for other uses, within a known distance of their source",
        "`trilight assets --epsilon 0.5%`",
        "epsilon",
        "0.5 %",
    ),
    Choice(
        "triangles of even size",
        "`--set assets.profile=uniform`",
        "profile",
        "uniform",
        "`faithful` is nearer and cheaper, and uneven, which this error does not see",
    ),
    Choice(
        "pictures without any loss from packing",
        "`--set storage.profile=lossless`",
        "codec",
        "profile lossless",
        "HTJ2K is smaller and as exact, but few programs read it yet",
    ),
    Choice(
        "lights that training mixes anew",
        "`--set renders.per_light=true`",
        "lights",
        "one picture of each light",
    ),
    Choice("as many different scenes as possible", "`--set scenes.num_views=1`", "views", "1"),
    Choice(
        "a large network's picture in less time",
        "`trilight render --engine neural --precision bfloat16`",
        "precision",
        "bfloat16",
    ),
    Choice(
        "a picture whose error is known",
        "`trilight render` as it is: path traced to 40 dB, or to what the outcome says",
        "noise-floor",
        "40 dB",
    ),
    Choice(
        "a look at what a network has learned",
        "`trilight render --engine neural`",
        "engines",
        "network",
        "one denoised sample of the path tracer is nearer; a film of one scene costs less",
    ),
)


def choices(folder: Path) -> Iterator[str]:
    """Yield the table as lines of Markdown, from the results in a folder.

    Raises:
        TrilightError: a point that is advised was not measured.
    """
    yield "| you need | choose | cost, divided by the default's | error (the default's) |"
    yield "|---|---|---|---|"
    for choice in CHOICES:
        (experiment,) = chosen([choice.experiment])
        found = newest_run(folder, experiment.name)
        if found is None:
            yield f"| {choice.need} | {choice.how} | not measured yet | |"
        else:
            yield _line(choice, experiment, rows(experiment, found[0]))


def _line(choice: Choice, experiment: Experiment, points: list[Row]) -> str:
    by_name = {row.point.name: row for row in points}
    if choice.point not in by_name:
        raise TrilightError(
            f"choice {choice.need!r}: {choice.point!r} was not measured; expected one of "
            f"{', '.join(by_name)}."
        )
    row = by_name[choice.point]
    assert experiment.error is not None
    error = shown_in(experiment.error, row)
    if not row.point.default:
        base = next(one for one in points if one.point.default)
        error = f"{error} ({shown_in(experiment.error, base)})"
    how = choice.how if row.on_front else f"{choice.how} (not on the front: {choice.despite})"
    cost = f"{shown(row.cost_ratio)} x {experiment.cost.name}"
    return f"| {choice.need} | {how} | {cost} | {error} {experiment.error.name} |"

"""The generated part of docs/tradeoffs.md: a section for each knob, and what to choose when.

<!-- trade:begin -->  ...everything between is written by `trilight bench trade --write-docs`
<!-- trade:end -->
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from infra.bench.trade.choices import CHOICES
from infra.bench.trade.curves import COST_NOISE, JudgedPoint, Knob, default_point, judged
from infra.bench.trade.figures import FIGURES, shown, shown_error
from infra.bench.trade.knobs import KNOBS, knob_named
from infra.bench.trade.saved import SavedCurve, saved_curves
from infra.bench.trade.workshop import CAREFUL, QUICK
from storage.errors import TrilightError

MARK = "trade"
"""Of the block on the page (infra.bench.marked_block)."""


def block(folder: Path) -> str:
    """Return the Markdown between the two markers, from the results in a folder."""
    curves = saved_curves(folder)
    lines = [*_head(curves)]
    for knob in KNOBS:
        lines += _section(knob, curves.get(knob.name))
    lines += _choices(curves)
    return "\n".join(lines) + "\n"


def _head(curves: Mapping[str, SavedCurve]) -> Iterator[str]:
    percent = f"{100 * COST_NOISE:.0f} %"
    yield "## Every knob: cost against error"
    yield ""
    yield (
        "Written by `trilight bench trade --write-docs` from the results in `docs/bench`; do not "
        "edit it here. Costs are core-seconds unless a table says otherwise; ratios are to the "
        "default of the same knob in the same run. A point is on the front where no other setting "
        f"has less error for at most {percent} more, nor the same error for more than "
        f"{percent} less: smaller differences in core-seconds are noise. In the figures "
        "the line is the front, the default is ringed, a triangle at the lower edge has no known "
        "error, and a cross is no setting."
    )
    yield from _not_run(curves)
    for file in sorted({saved.file for saved in curves.values()}):
        saved = next(one for one in curves.values() if one.file == file)
        yield ""
        yield f"`{file}`: {saved.processor}."


def _not_run(curves: Mapping[str, SavedCurve]) -> Iterator[str]:
    """Say for which knobs the careful measurement is still to be made."""
    quick = [knob.name for knob in KNOBS if knob.name in curves and curves[knob.name].quick]
    if not quick:
        return
    yield ""
    which = "all knobs" if len(quick) == len(curves) else ", ".join(f"`{name}`" for name in quick)
    yield (
        f"**Not run: careful**, for {which}. Their figures come from `--quick`: {QUICK.scenes} "
        f"scenes or fewer and {QUICK.objects} objects a knob, {QUICK.repeats} counted round of "
        f"what takes turns, where a careful run has {CAREFUL.scenes}, {CAREFUL.objects} and "
        f"{CAREFUL.repeats}. Differences of a decibel or of a tenth of the cost may be those of "
        "the few scenes."
    )


def _section(knob: Knob, saved: SavedCurve | None) -> Iterator[str]:
    yield ""
    yield f"### {knob.title}"
    yield ""
    names = ", ".join(f"`{name}`" for name in knob.covers)
    yield f"Settings: {names or 'none, the choice is made in the code'}."
    if saved is None:
        yield f"Not measured yet (`trilight bench trade --knob {knob.name}`)."
        yield ""
        yield f"Default: {knob.because}"
        return
    way = "more is better" if knob.better == "higher" else "less is better"
    yield f"Cost: {knob.cost}. Error: {knob.error} ({way}), against {knob.against}."
    if knob.also_cost:
        yield f"Also a cost: {', '.join(knob.also_cost)}."
    yield f"{saved.curve.measured_on[0].upper()}{saved.curve.measured_on[1:]} ({saved.date})."
    yield ""
    yield f"![Error against cost: {knob.title}](bench/{FIGURES}/{knob.name}.png)"
    yield ""
    yield from _table(knob, judged(knob, saved.curve))
    yield ""
    yield f"Default: {knob.because}"


def _table(knob: Knob, points: Sequence[JudgedPoint]) -> Iterator[str]:
    names = list(dict.fromkeys(name for one in points for name in one.point.further))
    yield f"| setting | cost | to the default | error | {' | '.join([*names, 'front'])} |"
    yield f"|{'---|' * (5 + len(names))}"
    for one in points:
        point = one.point
        setting = f"**{point.setting}**" if point.default else point.setting
        further = [shown(point.further[name]) if name in point.further else "" for name in names]
        cells = [
            setting,
            shown(point.cost),
            f"{shown(one.cost_ratio)} x",
            shown_error(knob, point.error),
            *further,
            mark(one),
        ]
        yield f"| {' | '.join(cells)} |"


def mark(one: JudgedPoint) -> str:
    """Return whether a point is on the front, in a word."""
    return {True: "yes", False: "no", None: "n/a"}[one.on_front]


def _choices(curves: Mapping[str, SavedCurve]) -> Iterator[str]:
    yield ""
    yield "### If you need this, choose that"
    yield ""
    yield "| you need | choose | cost, to the default's | error (the default's) |"
    yield "|---|---|---|---|"
    for choice in CHOICES:
        knob = knob_named(choice.knob)
        saved = curves.get(knob.name)
        if saved is None:
            yield f"| {choice.need} | {choice.how} | not measured yet | |"
            continue
        base = default_point(knob, saved.curve)
        points = {one.point.setting: one for one in judged(knob, saved.curve)}
        if choice.setting not in points:
            raise TrilightError(
                f"choice {choice.need!r}: {choice.setting!r} was not measured; expected one of "
                f"{', '.join(points)}."
            )
        one = points[choice.setting]
        error = shown_error(knob, one.point.error)
        if not one.point.default:
            error = f"{error} ({shown_error(knob, base.error)})"
        cost = f"{shown(one.cost_ratio)} x {knob.cost}"
        how = choice.how if one.on_front else f"{choice.how} (not on the front: {choice.despite})"
        yield f"| {choice.need} | {how} | {cost} | {error} {knob.error} |"

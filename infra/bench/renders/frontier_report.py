"""What the frontier says to people: a line per side, the ratios, and core-seconds against error."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench.renders.claims import Claim, Summary
from infra.bench.renders.frontier import Frontier, cycles_side, mitsuba_side, our_side
from infra.bench.renders.log_axis import plain_log

_FIRM_DB = 6.0
"""A reference this far above a picture adds a quarter of its squared error: a decibel."""


def rows(result: Frontier) -> list[tuple[str, str]]:
    """Return the result for people."""
    lines = [(summary.side, _line(summary)) for summary in result.summaries]
    lines += [(f"{claim.theirs} / {claim.ours}", _ratio(claim)) for claim in result.claims]
    as_good = {claim.theirs for claim in result.claims}
    missed = [cycles_side(spp) for spp in result.plan.cycles_spp if cycles_side(spp) not in as_good]
    lines += [(side, "no target of ours is as good over this set") for side in missed]
    floors = sorted(result.reference_floors_db.values())
    firm, total = _firm(result)
    lines.append(
        (
            "references",
            f"own floors {floors[0]:.1f} to {floors[-1]:.1f} dB; of our pictures {firm} of {total} "
            f"state at least {_FIRM_DB:.0f} dB less than their reference",
        )
    )
    return lines


def _firm(result: Frontier) -> tuple[int, int]:
    """Return how many of our pictures the references are well above, and how many there are."""
    above_db = [
        result.reference_floors_db[shot.scene] - shot.noise_floor_db
        for shot in result.shots
        if shot.noise_floor_db is not None
    ]
    return sum(db >= _FIRM_DB for db in above_db), len(above_db)


def _line(summary: Summary) -> str:
    stated = ""
    if summary.median_floor_db is not None and summary.over_stated is not None:
        stated = (
            f"; stated {summary.median_floor_db:.1f}, too good by over 1 dB in "
            f"{summary.over_stated:.0%}"
        )
    return (
        f"{summary.mean_core_s:.2f} core-s a view (median {summary.median_core_s:.2f}), "
        f"{summary.mean_spp:.0f} spp; true error median {summary.median_db:.1f}, p5 "
        f"{summary.p5_db:.1f}, worst {summary.worst_db:.1f} dB (linear "
        f"{summary.median_linear_db:.1f}, worst {summary.worst_linear_db:.1f}){stated}"
    )


def _ratio(claim: Claim) -> str:
    bound = "" if claim.bound == "exactly" else f"{claim.bound} "
    if claim.theirs == "mitsuba":
        return f"{bound}{claim.ratio:.1f} x at equal worst error ({claim.their_spp:.0f} spp)"
    return f"{bound}{claim.ratio:.1f} x, error not worse in median and worst"


def plot(result: Frontier, path: Path) -> None:
    """Draw core-seconds a view against the median and the worst true error."""
    plan = result.plan
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained", sharey=True)
    figures: Sequence[tuple[str, Callable[[Summary], float]]] = (
        ("median", lambda one: one.median_db),
        ("worst", lambda one: one.worst_db),
    )
    for axes, (title, error) in zip(panels, figures, strict=True):
        for label, style, points in _families(result):
            _curve(axes, label, style, points, error)
        axes.set_yscale("log")
        plain_log(axes.yaxis)
        axes.set_xlabel(f"{title} true error over {len(plan.scenes)} scenes, dB (psnr_log_db)")
        axes.grid(alpha=0.3, which="both")
        axes.margins(x=0.12, y=0.12)
    panels[0].set_ylabel("mean core-seconds a view")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    size = f"{plan.resolution} x {plan.resolution}"
    figure.suptitle(
        f"Cost at equal error: {size} views on {result.machine['cores']} cores, {result.date} "
        "(right and down is better)"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _families(result: Frontier) -> list[tuple[str, str, list[tuple[str, Summary]]]]:
    """Return (legend, style, labelled points) of every renderer that took part."""
    plan = result.plan
    by_side = {summary.side: summary for summary in result.summaries}
    ours = [(f"{target:.0f}", by_side[our_side(target)]) for target in plan.targets_db]
    mitsuba = [(str(spp), by_side[mitsuba_side(spp)]) for spp in plan.mitsuba_spp]
    cycles = [(str(spp), by_side[cycles_side(spp)]) for spp in plan.cycles_spp]
    families = [
        ("Trilight, target floor in dB", "o-", ours),
        ("plain Mitsuba + OIDN, samples", "s--", mitsuba),
        ("Cycles + OIDN, samples", "^:", cycles),
    ]
    return [family for family in families if family[2]]


def _curve(
    axes: Any,
    label: str,
    style: str,
    points: Sequence[tuple[str, Summary]],
    error: Callable[[Summary], float],
) -> None:
    xs, ys = [error(one) for _, one in points], [one.mean_core_s for _, one in points]
    (line,) = axes.plot(xs, ys, style, label=label)
    below = style.startswith("o")
    for x, y, texts in _together(points, xs, ys):
        axes.annotate(
            ", ".join(texts),
            (x, y),
            textcoords="offset points",
            xytext=(6, -12) if below else (-6, 5),
            ha="left" if below else "right",
            fontsize=8,
            color=line.get_color(),
        )


def _together(
    points: Sequence[tuple[str, Summary]], xs: Sequence[float], ys: Sequence[float]
) -> list[tuple[float, float, list[str]]]:
    """Return points with their labels; one that lies on the point before adds its label there."""
    found: list[tuple[float, float, list[str]]] = []
    for (text, _), x, y in zip(points, xs, ys, strict=True):
        if found and abs(found[-1][0] - x) < 0.1 and abs(found[-1][1] / y - 1) < 0.05:
            found[-1][2].append(text)
        else:
            found.append((x, y, [text]))
    return found

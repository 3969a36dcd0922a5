"""What `trilight bench assets` says to people: ratios, and the curve of triangles against error."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench import assets, remeshing
from infra.bench.harness import Comparison, Spread


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    lines = [
        (f"{side} at {budget}", _comparison(result, side, budget))
        for budget in assets.BUDGETS
        for side in (remeshing.REFERENCE, *remeshing.METHODS)
    ]
    for name, figures in result.sides.items():
        if name.startswith("source of"):
            lines.append((name, f"{figures['cpu_s'].median:.2f} CPU s, file to 1400 triangles"))
        if name.startswith("stage,"):
            objects = figures["accepted"].median + figures["rejected"].median
            per_minute = 60 * objects / figures["seconds"].median
            lines.append((name, f"{per_minute:.0f} objects a minute"))
        if name.startswith(("budget", "epsilon")):
            lines.append((name, _saving(result, figures)))
    return lines


def _comparison(result: Comparison, side: str, budget: int) -> str:
    figures = result.sides[f"{side} at {budget}"]
    if not figures["objects"].median:
        return "no object was large enough, or none was finished by every side"
    reference = result.sides[f"{remeshing.REFERENCE} at {budget}"]
    text = (
        f"{figures['objects'].median:.0f} objects, CPU {figures['cpu_s'].median:.3f} s, mean "
        f"{figures['error_mean'].median:.4%}, p99 {figures['error_p99'].median:.3%}, area "
        f"variation {figures['area_variation'].median:.2f}, angle p5 "
        f"{figures['min_angle_p5_deg'].median:.1f} deg"
    )
    if side == remeshing.REFERENCE:
        return text
    ratio = {
        name: reference[name].median / figures[name].median for name in figures if name in _RATIOS
    }
    return (
        text
        + "; reference / this: "
        + ", ".join(f"{_RATIOS[name]} {ratio[name]:.2f}" for name in _RATIOS)
    )


_RATIOS = {
    "cpu_s": "CPU",
    "error_mean": "mean",
    "error_p99": "p99",
    "area_variation": "area variation",
    "min_angle_p5_deg": "angle",
}


def _saving(result: Comparison, figures: Mapping[str, Spread]) -> str:
    fixed = result.sides[f"budget {assets.FIXED}"]["faces_mean"].median
    mean = figures["faces_mean"].median
    return (
        f"{mean:.0f} triangles on average, {1 - mean / assets.FIXED:.0%} fewer than {assets.FIXED} "
        f"for each, {1 - mean / fixed:.0%} fewer than up to {assets.FIXED}; "
        f"{figures['over_epsilon'].median:.0f} of {figures['accepted'].median:.0f} above "
        f"{assets.EPSILON:.1%}"
    )


def plot(result: Comparison, path: Path) -> None:
    """Draw error and time against the number of triangles."""
    figure, (error, seconds) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for side in remeshing.METHODS:
        found = [result.sides[f"curve {side} at {budget}"] for budget in assets.CURVE]
        found = [figures for figures in found if figures["objects"].median]
        if not found:
            continue
        faces = [figures["faces"].median for figures in found]
        error.loglog(
            faces, [100 * f["error_p99"].median for f in found], "o-", label=f"{side}, p99"
        )
        color = error.lines[-1].get_color()
        error.loglog(faces, [100 * f["error_mean"].median for f in found], "o:", color=color)
        seconds.semilogx(faces, [1000 * f["cpu_s"].median for f in found], "o-", label=side)
    count = result.sides[f"curve {next(iter(remeshing.METHODS))} at {assets.CURVE[0]}"]["objects"]
    error.set_ylabel("two-way distance, % of the diagonal (dotted: mean)")
    seconds.set_ylabel("processor time, ms (clean, orient, decimate)")
    for axes in (error, seconds):
        axes.set_xlabel("triangles")
        axes.legend()
        axes.grid(alpha=0.3, which="both")
    figure.suptitle(f"Median of {count.median:.0f} objects, {result.date}")
    figure.savefig(path, dpi=110)
    plt.close(figure)

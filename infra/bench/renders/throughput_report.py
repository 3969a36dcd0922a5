"""What the throughput says to people: a line per resolution and target, and the curves."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench.renders.log_axis import plain_log
from infra.bench.renders.throughput import MANY_VIEWS, Economy, Throughput


def rows(result: Throughput) -> list[tuple[str, str]]:
    """Return the result for people."""
    lines = [
        (f"{one.resolution} x {one.resolution} to {one.target_db:.0f} dB", _line(one))
        for one in result.economies
    ]
    loading = max(one.load_core_s for one in result.economies)
    return [
        *lines,
        ("loading a scene", f"{loading:.2f} core-s, once for all of its views, not counted above"),
        ("price", f"{result.usd_per_core_hour:g} USD per core-hour"),
        ("cap", f"{result.plan.max_spp} samples per pixel"),
    ]


def _line(one: Economy) -> str:
    return (
        f"{one.views_per_core_hour:.0f} views per core-hour; {one.share_reached:.0%} of "
        f"{one.num_views} reached it; floor median {one.median_floor_db:.1f}, p5 "
        f"{one.p5_floor_db:.1f} dB; {one.mean_spp:.0f} spp; {MANY_VIEWS / 1e6:g} million views "
        f"{_usd(one.usd_for_many)}"
    )


def _usd(amount: float) -> str:
    return f"{amount:,.0f} USD".replace(",", " ")


def plot(result: Throughput, path: Path) -> None:
    """Draw views per core-hour against the target, with the share of views that reached it."""
    figure, axes = plt.subplots(figsize=(7.5, 4.8), layout="constrained")
    for resolution in result.plan.resolutions:
        line = [one for one in result.economies if one.resolution == resolution]
        targets, speeds = [one.target_db for one in line], [one.views_per_core_hour for one in line]
        label = f"{resolution} x {resolution}"
        (drawn,) = axes.plot(targets, speeds, "o-", label=label)
        for one in line:
            axes.annotate(
                f"{one.share_reached:.0%} reach it\n{_usd(one.usd_for_many)}",
                (one.target_db, one.views_per_core_hour),
                textcoords="offset points",
                xytext=(5, 6),  # the curves fall: right above is free
                ha="left",
                fontsize=8,
                color=drawn.get_color(),
            )
    axes.set_yscale("log")
    plain_log(axes.yaxis)
    axes.margins(x=0.2, y=0.25)
    axes.set_xticks(result.plan.targets_db)
    axes.set_xlabel("target noise floor, dB (psnr_log_db)")
    axes.set_ylabel("views per core-hour")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    axes.set_title(
        f"{len(result.plan.scenes)} views, at most {result.plan.max_spp} spp, on "
        f"{result.machine['cores']} cores, {result.date}\nUSD for {MANY_VIEWS / 1e6:g} million "
        f"views at {result.usd_per_core_hour:g} per core-hour",
        fontsize=10,
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)

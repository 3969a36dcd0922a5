"""The streaming benchmark for people: rows, and a figure of rates."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt

from infra.bench.harness import Comparison, Spread
from infra.bench.streaming import (
    APART,
    CAT,
    COLD,
    MANIFESTS,
    OFF,
    OFF_CHECKED,
    PARTS,
    PROCESSES,
    THREADS,
    WARM,
    manifest_side,
    threads_side,
)

_AIM = 0.4
"""Share of `cat` that reading alone is to reach."""


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    cat = result.sides[CAT]["mb_per_s"].median
    lines = [(CAT, f"{cat:.0f} MB/s")]
    for side in (OFF, OFF_CHECKED):
        figures = result.sides[side]
        rate = figures["mb_per_s"].median
        samples = figures["samples_per_s"].median
        lines.append((side, f"{rate:.0f} MB/s, {rate / cat:.0%} of cat; {samples:.0f} a second"))
    parts = result.sides[PARTS]
    named = {name.removesuffix("_ms"): parts[name].median for name in parts if name != "seconds"}
    lines.append((PARTS, ", ".join(f"{name} {value:.2f} ms" for name, value in named.items())))
    sides = [threads_side(threads) for threads in THREADS]
    lines += [(side, _rate(result.sides[side])) for side in sides]
    lines.append((APART, f"{result.sides[APART]['samples_per_s'].median:.0f} samples a second"))
    for side in (COLD, WARM):
        figures = result.sides[side]
        wire, held = figures["wire_bytes_per_sample"].median, figures["bytes_per_sample"].median
        lines.append(
            (side, f"{_rate(figures)}; {wire:.0f} bytes on the wire a sample of {held:.0f}")
        )
    return lines + [(manifest_side(size), _opening(result, size)) for size in MANIFESTS]


def _opening(result: Comparison, size: int) -> str:
    figures = result.sides[manifest_side(size)]
    peak, held = figures["peak_bytes"].median / 1e6, figures["held_bytes"].median / 1e6
    return f"{peak:.1f} MB at most, {held:.1f} MB held, {figures['open_s'].median:.2f} s"


def _rate(figures: Mapping[str, Spread]) -> str:
    rate, first = figures["samples_per_s"], figures["first_batch_s"].median
    return f"{rate.median:.0f} samples a second, first batch after {first:.2f} s"


def plot(result: Comparison, path: Path) -> None:
    """Draw bytes a second beside `cat`, and samples a second by threads."""
    figure, (of_bytes, of_samples) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    names = (CAT, OFF, OFF_CHECKED)
    of_bytes.barh(names, [result.sides[name]["mb_per_s"].median for name in names])
    aim = _AIM * result.sides[CAT]["mb_per_s"].median
    of_bytes.axvline(aim, color="grey", linestyle="--", label=f"{_AIM:.0%} of cat")
    of_bytes.set_xlabel("MB/s, one process")
    of_bytes.legend()
    rates = [result.sides[threads_side(count)]["samples_per_s"] for count in THREADS]
    middle = [rate.median for rate in rates]
    spread = [
        [rate.median - rate.low for rate in rates],
        [rate.high - rate.median for rate in rates],
    ]
    of_samples.errorbar(THREADS, middle, spread, fmt="o-", capsize=3)
    apart = result.sides[APART]["samples_per_s"].median
    of_samples.plot([PROCESSES], [apart], "k^", label=f"{PROCESSES} processes, a thread each")
    of_samples.legend()
    of_samples.set_xlabel("decoding threads")
    of_samples.set_ylabel("samples a second")
    of_samples.set_ylim(bottom=0)
    of_samples.grid(alpha=0.3)
    figure.suptitle(f"reading shards, {result.machine['cores']} cores, {result.date}")
    figure.savefig(path, dpi=110)
    plt.close(figure)

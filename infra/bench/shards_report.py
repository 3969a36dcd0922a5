"""What `trilight bench shards` says to people: a line per codec, ratios, and the curves."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench.harness import Comparison, Spread
from infra.bench.shard_arrays import ARRAYS, COLOURS, SAMPLES, TEXTURES
from infra.bench.shard_pictures import LEVELS, codecs
from storage.profiles import LAW_DB

_OURS = "indexed, deflate"
"""The form of arrays in the profile `compact`."""

_LABEL: Any = {"fontsize": 6, "textcoords": "offset points", "xytext": (3, 3)}


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    lines = [(name, _picture(result.sides[f"picture {name}"])) for name in codecs()]
    for colours in COLOURS:
        for form in ARRAYS:
            figures = result.sides[f"arrays {form}, {colours}"]
            lines.append((f"arrays {form}, {colours}", _bytes_and_time(figures)))
    lines += [(f"sample {name}", _sample(result.sides[f"sample {name}"])) for name in SAMPLES]
    return lines + _ratios(result)


def _picture(figures: Mapping[str, Spread]) -> str:
    kilobytes = figures["bytes"].median / 1e3
    ratio = figures["raw_bytes"].median / figures["bytes"].median
    return (
        f"{kilobytes:.1f} kB, {ratio:.2f} x; {figures['encode_ms'].median:.1f} / "
        f"{figures['decode_ms'].median:.2f} ms; error {figures['below_floor_db'].median:.1f} dB "
        f"below the floor (p5 {figures['below_floor_p5_db'].median:.1f}, worst "
        f"{figures['below_floor_min_db'].median:.1f}), {figures['lawful'].median:.0%} lawful"
    )


def _bytes_and_time(figures: Mapping[str, Spread]) -> str:
    return (
        f"{figures['bytes'].median / 1e3:.1f} kB, in memory "
        f"{figures['memory_bytes'].median / 1e3:.0f} kB, {figures['decode_ms'].median:.2f} ms"
    )


def _sample(figures: Mapping[str, Spread]) -> str:
    return f"{_bytes_and_time(figures)}, {1000 / figures['decode_ms'].median:.0f} a second"


def _ratios(result: Comparison) -> list[tuple[str, str]]:
    """Return how many times ours is smaller or faster than the HDF5 files."""
    lines = []
    for texture in TEXTURES:
        for colours in COLOURS:
            theirs = result.sides[f"arrays HDF5 {texture}, {colours}"]
            ours = result.sides[f"arrays {_OURS}, {colours}"]
            lines.append((f"HDF5 {texture} / {_OURS}, {colours}", _times(theirs, ours)))
        for profile in SAMPLES[: -len(TEXTURES)]:
            theirs = result.sides[f"sample HDF5 {texture}"]
            ours = result.sides[f"sample {profile}"]
            lines.append((f"sample HDF5 {texture} / {profile}", _times(theirs, ours)))
    return lines


def _times(theirs: Mapping[str, Spread], ours: Mapping[str, Spread]) -> str:
    named = {"bytes": "bytes", "memory_bytes": "memory", "decode_ms": "time"}
    return ", ".join(
        f"{name} {theirs[figure].median / ours[figure].median:.1f} x"
        for figure, name in named.items()
    )


def plot(result: Comparison, path: Path) -> None:
    """Draw error and time of unpacking against the bytes of a picture."""
    figure, (error, seconds) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    raw = result.sides["picture raw half floats"]["raw_bytes"].median
    points = {name: result.sides[f"picture {name}"] for name in codecs()}
    for family, levels in LEVELS.items():
        line = [points[f"{family} {level}"] for level in levels]
        times = [raw / side["bytes"].median for side in line]
        error.plot(times, [s["below_floor_p5_db"].median for s in line], "o-", label=family)
        seconds.plot(times, [s["decode_ms"].median for s in line], "o-", label=family)
    for name, side in points.items():
        if name.split(" ")[0] in LEVELS:
            continue
        at = (raw / side["bytes"].median, side["below_floor_p5_db"].median)
        error.plot(*at, "k.")
        if side["lawful"].median < 1 or name == "profile compact":  # exact ones are one heap
            error.annotate(name, at, **_LABEL)
        at = (at[0], side["decode_ms"].median)
        seconds.plot(*at, "k.")
        seconds.annotate(name, at, **_LABEL)
    error.axhline(LAW_DB, color="grey", linestyle="--", label="law of the tenth")
    error.set_ylabel("error below the noise floor, dB, 5th percentile of views")
    seconds.set_ylabel("unpacking a view, ms of one thread")
    for axes in (error, seconds):
        axes.set_xlabel("times smaller than raw half floats")
        axes.grid(alpha=0.3)
        axes.legend()
    floor_db = points["ZIP"]["floor_db"].median
    figure.suptitle(f"256 x 256 views, median floor {floor_db:.1f} dB, {result.date}")
    figure.savefig(path, dpi=110)
    plt.close(figure)

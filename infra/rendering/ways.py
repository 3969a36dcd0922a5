"""Which way to a picture a person's seconds or decibels choose, from what ways cost and miss.

What is expected is what the shipped scenes had in their median. It says nothing certain of the
picture at hand: a measured error needs more samples (`--noise-floor`).
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from infra.rendering.way_table import (
    NETWORK_SCENE,
    NETWORK_VIEW,
    KnownCosts,
    PictureCosts,
    Rung,
    WayError,
    WayTable,
)
from pipeline.renders.preview_parts import SCENE, preview_parts, seconds_of
from pipeline.renders.settings import Filtered
from storage.errors import TrilightError

_LEAST_S = 1e-9
"""Seconds below this count as this, so that logarithms can be taken."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """One way to make a picture."""

    rung: Rung
    """Traced, or by the network."""
    spp: int
    """Samples per pixel; 0 of the network."""
    denoiser: Filtered
    """Filter of Open Image Denoise; off with the network."""

    def __str__(self) -> str:
        """Return the way for a person."""
        if self.rung == "network":
            return "the network builtin:tokens"
        return f"{self.spp} sample{'s' if self.spp > 1 else ''} a pixel, filter {self.denoiser}"

    @property
    def scene_part(self) -> str:
        """Name of what a scene takes before its first picture."""
        return NETWORK_SCENE if self.rung == "network" else SCENE

    @property
    def view_parts(self) -> Counter[str]:
        """How often each part occurs in a picture."""
        if self.rung == "network":
            return Counter([NETWORK_VIEW])
        return preview_parts(self.spp, self.denoiser)


@dataclass(frozen=True, kw_only=True)
class Priced:
    """A way with what is expected of it at one width."""

    way: Way
    seconds: float
    """Wall-clock seconds of a picture, start-up aside."""
    db: float
    """Median psnr_log_db over the scenes of the table."""
    least_db: float
    """That of the worst of them."""
    judged_px: int
    """Width in pixels of which this error is: that of the pictures asked for, or the nearest of
    those at which the way was measured where it lies beyond them."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """What was chosen for whom, and what is expected of it."""

    asked: str
    """The option with its value."""
    priced: Priced
    """The way."""
    fits: bool
    """Whether it keeps to what was asked."""
    scenes: int
    """Number of scenes behind the expected error."""
    costs: str
    """Where the costs are from, as the end of a sentence."""

    @property
    def engine(self) -> Literal["mitsuba", "neural"]:
        """The engine that makes its pictures."""
        return "neural" if self.priced.way.rung == "network" else "mitsuba"

    @property
    def sentence(self) -> str:
        """The choice for a person, in one line."""
        one = self.priced
        lead = "chosen" if self.fits else "nothing is as quick; the quickest is chosen"
        return (
            f"{self.asked}: {lead}: {one.way}; expected {one.db:.1f} dB in the median of "
            f"{self.scenes} scenes at {one.judged_px} pixels ({one.least_db:.1f} in the worst), in "
            f"{_shown_s(one.seconds)} s after start-up; {self.costs}"
        )

    @property
    def facts(self) -> Mapping[str, str | float]:
        """What the header of a picture says of it."""
        return {
            "chosen_for": self.asked,
            "expected_db": round(self.priced.db, 2),
            "expected_seconds": float(f"{self.priced.seconds:.4g}"),
        }


def priced_ways(
    table: WayTable,
    costs: PictureCosts,
    *,
    width: int,
    threads: int,
    per_scene: float,
    network: bool,
) -> list[Priced]:
    """Return every way with its price and error.

    Args:
        table: the ways and their errors.
        costs: of their parts.
        width: of a picture in pixels.
        threads: that work; no more than there are cores.
        per_scene: pictures that share the loading of a scene, at least 1.
        network: whether the network can run here; it is a way only at widths between those at which
            it was judged.
    """
    part_s = _part_seconds(costs, width, threads)
    rows: dict[Way, list[WayError]] = {}
    for row in table.errors:
        way = Way(rung=row.rung, spp=row.spp, denoiser=row.denoiser)
        if network or row.rung != "network":
            rows.setdefault(way, []).append(row)
            rows[way].sort(key=lambda each: each.width)
    return [
        Priced(
            way=way,
            seconds=part_s[way.scene_part] / per_scene + seconds_of(way.view_parts, part_s),
            db=_at_width(width, {row.width: row.median_db for row in of_way}),
            least_db=_at_width(width, {row.width: row.least_db for row in of_way}),
            judged_px=min(max(width, of_way[0].width), of_way[-1].width),
        )
        for way, of_way in rows.items()
        # samples come nearer the truth as pictures grow, a network leaves what it was trained on
        if way.rung == "traced" or of_way[0].width <= width <= of_way[-1].width
    ]


def within_seconds(ways: Sequence[Priced], seconds: float) -> tuple[Priced, bool]:
    """Return the way of least error that keeps to the seconds, the cheaper of equals, and True.

    Where none does, return the quickest and False.
    """
    fitting = [one for one in ways if one.seconds <= seconds]
    if not fitting:
        return min(ways, key=lambda one: (one.seconds, -one.db)), False
    return max(fitting, key=lambda one: (one.db, -one.seconds)), True


def reaching(ways: Sequence[Priced], db: float, width: int) -> Priced:
    """Return the quickest way whose median error reaches `db`, the better of equals.

    Raises:
        TrilightError: none does.
    """
    good = [one for one in ways if one.db >= db]
    if not good:
        most = max(one.db for one in ways)
        raise TrilightError(
            f"--error is {db:g}; expected at most {math.floor(10 * most) / 10} dB at {width} "
            f"pixels, the most that previews reach; --noise-floor {db:g} samples until the error "
            "is measured to be that."
        )
    return min(good, key=lambda one: (one.seconds, -one.db))


def chosen_way(
    ways: Sequence[Priced],
    table: WayTable,
    known: KnownCosts,
    *,
    seconds: float | None,
    error_db: float | None,
    width: int,
) -> Choice:
    """Return the choice of seconds or of an error, one of which is given; as `reaching`."""
    if seconds is not None:
        asked = f"--seconds {seconds:g}"
        priced, fits = within_seconds(ways, seconds)
    else:
        assert error_db is not None
        asked = f"--error {error_db:g}"
        priced = reaching(ways, error_db, width)
        fits = True
    return Choice(asked=asked, priced=priced, fits=fits, scenes=table.scenes, costs=known.source)


def _part_seconds(costs: PictureCosts, width: int, threads: int) -> dict[str, float]:
    """Return the seconds of every part, interpolated between widths in logarithms.

    Below the least width they are those of that width, which is more than they are; above the
    greatest they grow with the pixels.
    """
    found: dict[str, dict[int, float]] = {}
    for row in costs.rows:
        seconds = max(row.serial_s + row.parallel_s / threads, _LEAST_S)
        found.setdefault(row.part, {})[row.width] = seconds
    return {part: _cost_at(width, by_width) for part, by_width in found.items()}


def _cost_at(width: int, by_width: Mapping[int, float]) -> float:
    logs = {each: math.log(seconds) for each, seconds in by_width.items()}
    inside = math.exp(_at_width(width, logs))
    return inside * max(width / max(by_width), 1.0) ** 2


def _at_width(width: int, by_width: Mapping[int, float]) -> float:
    """Return a value between those of measured widths; beyond them, that of the nearest."""
    widths = sorted(by_width)
    values = [by_width[each] for each in widths]
    return float(np.interp(math.log2(width), np.log2(widths), values))


def _shown_s(seconds: float) -> str:
    return f"{seconds:.2g}" if seconds < 10 else f"{seconds:.0f}"

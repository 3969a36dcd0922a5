"""Chooses samples per pixel and denoiser, or the network, for a time or error budget.

The expected error is the median over the shipped scenes; a single picture may differ from it. A
measured error needs more samples (`--noise-floor`).
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from infra.render.way_table import (
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
"""Lower bound of seconds, so that logarithms can be taken."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """Quality preset: samples per pixel and denoiser, or the network."""

    rung: Rung
    """Method: traced, or by the network."""
    spp: int
    """Samples per pixel; 0 for the network."""
    denoiser: Filtered
    """Filter of Open Image Denoise; off for the network."""

    def __str__(self) -> str:
        """Return the preset as text."""
        if self.rung == "network":
            return "the network builtin:tokens"
        return f"{self.spp} sample{'s' if self.spp > 1 else ''} a pixel, filter {self.denoiser}"

    @property
    def scene_part(self) -> str:
        """Name of the part that a scene costs once, before its first picture."""
        return NETWORK_SCENE if self.rung == "network" else SCENE

    @property
    def view_parts(self) -> Counter[str]:
        """Number of occurrences of each part in a picture."""
        if self.rung == "network":
            return Counter([NETWORK_VIEW])
        return preview_parts(self.spp, self.denoiser)


@dataclass(frozen=True, kw_only=True)
class Priced:
    """Quality preset with its expected cost and error at one width."""

    way: Way
    seconds: float
    """Wall-clock seconds of a picture, without start-up."""
    db: float
    """Median psnr_log_db over the scenes of the table."""
    least_db: float
    """psnr_log_db of the worst scene of the table."""
    judged_px: int
    """Width in pixels at which the error was measured: that of the pictures, or beyond the measured
    widths the nearest of them."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Chosen quality preset, and its expected cost and error."""

    option: str
    """Option that chose the preset, with its value."""
    priced: Priced
    fits: bool
    """True where the preset keeps to the budget."""
    scenes: int
    """Number of scenes behind the expected error."""
    costs: str
    """Source of the costs, as the end of a sentence."""

    @property
    def engine(self) -> Literal["mitsuba", "neural"]:
        """Engine that renders the preset."""
        return "neural" if self.priced.way.rung == "network" else "mitsuba"

    @property
    def sentence(self) -> str:
        """The choice as one line of text."""
        one = self.priced
        lead = "chosen" if self.fits else "nothing is as quick; the quickest is chosen"
        return (
            f"{self.option}: {lead}: {one.way}; expected {one.db:.1f} dB in the median of "
            f"{self.scenes} scenes at {one.judged_px} pixels ({one.least_db:.1f} in the worst), in "
            f"{_seconds_text(one.seconds)} s after start-up; {self.costs}"
        )

    @property
    def facts(self) -> Mapping[str, str | float]:
        """Facts for the header of a picture."""
        return {
            "chosen_for": self.option,
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
    """Return every quality preset with its expected cost and error.

    Args:
        table: presets and their errors.
        costs: costs of the parts of pictures.
        width: width of a picture in pixels.
        threads: number of threads; no more than there are cores.
        per_scene: pictures that share the loading of a scene, at least 1.
        network: whether the network can run here; it is offered only between the widths at which it
            was measured.
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
        # more pixels do not harm samples; a network fails beyond the widths of its training
        if way.rung == "traced" or of_way[0].width <= width <= of_way[-1].width
    ]


def within_seconds(candidates: Sequence[Priced], seconds: float) -> tuple[Priced, bool]:
    """Return the preset of least error within the seconds, the cheaper of equals, and True.

    Where none fits, return the fastest preset and False.
    """
    fitting = [one for one in candidates if one.seconds <= seconds]
    if not fitting:
        return min(candidates, key=lambda one: (one.seconds, -one.db)), False
    return max(fitting, key=lambda one: (one.db, -one.seconds)), True


def reaching(candidates: Sequence[Priced], db: float, width: int) -> Priced:
    """Return the fastest preset whose median error reaches `db`, the better of equals.

    Raises:
        TrilightError: no preset reaches it.
    """
    good = [one for one in candidates if one.db >= db]
    if not good:
        most = max(one.db for one in candidates)
        raise TrilightError(
            f"--error is {db:g}; expected at most {math.floor(10 * most) / 10} dB at {width} "
            f"pixels, the most that previews reach; --noise-floor {db:g} samples until the error "
            "is measured to be that."
        )
    return min(good, key=lambda one: (one.seconds, -one.db))


def chosen_way(
    candidates: Sequence[Priced],
    table: WayTable,
    known: KnownCosts,
    *,
    seconds: float | None,
    error_db: float | None,
    width: int,
) -> Choice:
    """Return the preset for seconds or for an error; raises TrilightError as `reaching`."""
    if seconds is not None:
        option = f"--seconds {seconds:g}"
        priced, fits = within_seconds(candidates, seconds)
    else:
        assert error_db is not None
        option = f"--error {error_db:g}"
        priced = reaching(candidates, error_db, width)
        fits = True
    return Choice(option=option, priced=priced, fits=fits, scenes=table.scenes, costs=known.source)


def _part_seconds(costs: PictureCosts, width: int, threads: int) -> dict[str, float]:
    """Return the seconds of every part, interpolated between widths in logarithms.

    Below the least width they are those of that width, which is an upper bound; above the greatest
    they grow with the number of pixels.
    """
    by_part: dict[str, dict[int, float]] = {}
    for row in costs.rows:
        seconds = max(row.serial_s + row.parallel_s / threads, _LEAST_S)
        by_part.setdefault(row.part, {})[row.width] = seconds
    return {part: _cost_at(width, by_width) for part, by_width in by_part.items()}


def _cost_at(width: int, by_width: Mapping[int, float]) -> float:
    logs = {each: math.log(seconds) for each, seconds in by_width.items()}
    inside = math.exp(_at_width(width, logs))
    return inside * max(width / max(by_width), 1.0) ** 2


def _at_width(width: int, by_width: Mapping[int, float]) -> float:
    """Return a value interpolated between measured widths; beyond them, that of the nearest."""
    widths = sorted(by_width)
    values = [by_width[each] for each in widths]
    return float(np.interp(math.log2(width), np.log2(widths), values))


def _seconds_text(seconds: float) -> str:
    return f"{seconds:.2g}" if seconds < 10 else f"{seconds:.0f}"

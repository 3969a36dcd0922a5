"""Chooses samples per pixel and denoiser, or the network, for a time or error budget.

The expected error is the median over the shipped scenes; a single picture may differ from it. A
measured error needs more samples (`--noise-floor`).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from infra.render.preview_table import (
    NETWORK_SCENE,
    NETWORK_VIEW,
    KnownCosts,
    PictureCosts,
    PreviewError,
    PreviewTable,
)
from infra.render.quality import Budget, FixedSamples, TimeBudget
from pipeline.renders.preview import SCENE, preview_parts, seconds_of
from storage.errors import TrilightError

NETWORK = "the network builtin:tokens"

_LEAST_S = 1e-9
"""Lower bound of seconds, so that logarithms can be taken."""


@dataclass(frozen=True, kw_only=True)
class Priced:
    """Samples or the network, with expected cost and error at one width."""

    samples: FixedSamples | None
    """Samples and filter; None for the network builtin:tokens."""
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
    """Chosen samples or network, and the expected cost and error."""

    budget: Budget
    priced: Priced
    fits: bool
    """True where the choice keeps to the budget."""
    scenes: int
    """Number of scenes behind the expected error."""
    costs: str
    """Source of the costs, as the end of a sentence."""

    @property
    def engine(self) -> Literal["mitsuba", "neural"]:
        """Engine that renders it."""
        return "neural" if self.priced.samples is None else "mitsuba"

    @property
    def sentence(self) -> str:
        """The choice as one line of text."""
        one = self.priced
        lead = "chosen" if self.fits else "nothing is as quick; the quickest is chosen"
        seconds = f"{one.seconds:.2g}" if one.seconds < 10 else f"{one.seconds:.0f}"
        return (
            f"{self.budget}: {lead}: {one.samples or NETWORK}; expected {one.db:.1f} dB in the "
            f"median of {self.scenes} scenes at {one.judged_px} pixels ({one.least_db:.1f} in the "
            f"worst), in {seconds} s after start-up; {self.costs}"
        )

    @property
    def facts(self) -> Mapping[str, str | float]:
        """Facts for the header of a picture."""
        return {
            "chosen_for": str(self.budget),
            "expected_db": round(self.priced.db, 2),
            "expected_seconds": float(f"{self.priced.seconds:.4g}"),
        }


def price_all(
    table: PreviewTable,
    costs: PictureCosts,
    *,
    width: int,
    threads: int,
    per_scene: float,
    network: bool,
) -> list[Priced]:
    """Return every row of the table with its expected cost and error.

    Args:
        threads: number of threads; no more than there are cores.
        per_scene: pictures that share the loading of a scene, at least 1.
        network: whether the network can run here; it is offered only between the widths at which it
            was measured.
    """
    part_s = _part_seconds(costs, width, threads)
    rows: dict[FixedSamples | None, list[PreviewError]] = {}
    for row in table.errors:
        traced = FixedSamples(spp=row.spp, denoiser=row.denoiser)
        if network or row.rung != "network":
            rows.setdefault(traced if row.rung == "traced" else None, []).append(row)
    priced = []
    for samples, unsorted in rows.items():
        errors = sorted(unsorted, key=lambda each: each.width)
        least = errors[0].width
        most = errors[-1].width
        # more pixels do not harm samples; a network fails beyond the widths of its training
        if samples is None and not least <= width <= most:
            continue
        if samples is None:
            seconds = part_s[NETWORK_SCENE] / per_scene + part_s[NETWORK_VIEW]
        else:
            parts = preview_parts(samples.spp, samples.denoiser)
            seconds = part_s[SCENE] / per_scene + seconds_of(parts, part_s)
        priced.append(
            Priced(
                samples=samples,
                seconds=seconds,
                db=_at_width(width, {row.width: row.median_db for row in errors}),
                least_db=_at_width(width, {row.width: row.least_db for row in errors}),
                judged_px=min(max(width, least), most),
            )
        )
    return priced


def choose_within(candidates: Sequence[Priced], seconds: float) -> tuple[Priced, bool]:
    """Return the candidate of least error within the seconds, the cheaper of equals, and True.

    Where none fits, return the fastest candidate and False.
    """
    fitting = [one for one in candidates if one.seconds <= seconds]
    if not fitting:
        return min(candidates, key=lambda one: (one.seconds, -one.db)), False
    return max(fitting, key=lambda one: (one.db, -one.seconds)), True


def choose_reaching(candidates: Sequence[Priced], db: float, width: int) -> Priced:
    """Return the fastest candidate whose median error reaches `db`, the better of equals.

    Raises:
        TrilightError: none reaches it.
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


def choose(
    budget: Budget, candidates: Sequence[Priced], table: PreviewTable, known: KnownCosts, width: int
) -> Choice:
    """Return the choice for a budget; raises TrilightError as `choose_reaching`."""
    if isinstance(budget, TimeBudget):
        priced, fits = choose_within(candidates, budget.seconds)
    else:
        priced = choose_reaching(candidates, budget.error_db, width)
        fits = True
    return Choice(budget=budget, priced=priced, fits=fits, scenes=table.scenes, costs=known.source)


def _part_seconds(costs: PictureCosts, width: int, threads: int) -> dict[str, float]:
    """Return the seconds of every part, interpolated between widths in logarithms.

    Below the least width they are those of that width, which is an upper bound; above the greatest
    they grow with the number of pixels.
    """
    by_part: dict[str, dict[int, float]] = {}
    for row in costs.rows:
        seconds = max(row.serial_s + row.parallel_s / threads, _LEAST_S)
        by_part.setdefault(row.part, {})[row.width] = seconds
    part_s = {}
    for part, by_width in by_part.items():
        logs = {each: math.log(seconds) for each, seconds in by_width.items()}
        beyond = max(width / max(by_width), 1.0)
        part_s[part] = math.exp(_at_width(width, logs)) * beyond**2
    return part_s


def _at_width(width: int, by_width: Mapping[int, float]) -> float:
    """Return a value interpolated between measured widths; beyond them, that of the nearest."""
    widths = sorted(by_width)
    values = [by_width[each] for each in widths]
    return float(np.interp(math.log2(width), np.log2(widths), values))

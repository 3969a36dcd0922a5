"""Tables of cost and error of previews, by which `trilight render --seconds` and `--error` choose.

They choose samples per pixel and denoiser, or the network. The expected error is the median over
the shipped scenes; a single picture may differ from it. A measured error needs more samples
(`--noise-floor`).

Errors are shipped: they do not depend on the machine. Costs are shipped as well, as CPU seconds of
the machine on which they were measured; `trilight doctor --measure` times the same parts on this
machine and writes them into the user's cache.
"""

import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from pipeline.renders.mitsuba_variant import Variant
from pipeline.renders.preview import MOST_SPP, SCENE, PreviewSettings, preview_parts, samples_text
from pipeline.renders.settings import Filtered, Resolution
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.machine import available_cores, processor
from storage.metrics import MAX_DB
from storage.settings.described import checked, from_record, settings_record
from storage.settings.ranges import Within
from storage.typed_json import read_json

SHIPPED = Path(__file__).with_name("previews.json")
"""File that infra.setup.preview_table measures and writes."""

NETWORK_SCENE = "network scene"
NETWORK_VIEW = "network view"
"""Parts of a picture of the network builtin:tokens, in addition to preview_parts."""

MEASURE = "trilight doctor --measure"
"""Command that writes the costs of this machine."""

Seconds = Annotated[float, Within(0, 1e6, unit="seconds")]
Decibels = Annotated[float, Within(-MAX_DB, MAX_DB, unit="dB")]


@checked("costs of a part")
class PartCost:
    """Seconds of one part of a picture at a width: `serial_s` + `parallel_s` / threads."""

    part: str
    """Name of the part, such as a sample, the filter, or `network view`."""
    width: Resolution
    """Width of the picture in pixels."""
    serial_s: Seconds
    """Seconds that more threads do not shorten."""
    parallel_s: Seconds
    """CPU seconds that are divided by the number of threads."""


@checked("costs of previews")
class PictureCosts:
    """Costs of the parts of pictures on one machine."""

    machine: str
    """Processor, cores and variant of Mitsuba."""
    rows: tuple[PartCost, ...]
    """Costs of each part at each width."""


@checked("the error of a preview")
class PreviewError:
    """Error of pictures of a number of samples, or of the network, at a width."""

    rung: Literal["traced", "network"]
    """Few samples and a filter, or the network builtin:tokens, cheapest for further views."""
    spp: Annotated[int, Within(0, MOST_SPP, unit="samples")]
    """Samples per pixel; 0 for the network."""
    denoiser: Filtered
    """Filter of Open Image Denoise; off for the network."""
    width: Resolution
    """Width of the pictures in pixels."""
    median_db: Decibels
    """Median psnr_log_db over the scenes, against raw references."""
    least_db: Decibels
    """psnr_log_db of the worst scene."""


@checked("the table of previews")
class PreviewTable:
    """Shipped errors and costs of all previews."""

    scenes: Annotated[int, Within(1, 1_000_000, unit="scenes")]
    """Number of scenes, one view each."""
    errors: tuple[PreviewError, ...]
    """Errors of each preview at each measured width."""
    costs: PictureCosts
    """Median CPU seconds of the parts on one thread."""
    probe: PictureCosts
    """Mean CPU seconds of the parts over the probe scenes, which other machines time as well."""


@functools.cache
def shipped_table() -> PreviewTable:
    """Return the shipped table."""
    return from_record(PreviewTable, json.loads(SHIPPED.read_bytes()))


def machine_name(variant: Variant) -> str:
    """Return processor, cores and Mitsuba variant, on which costs depend."""
    return f"{processor()}, {available_cores()} cores, {variant.name}"


def machine_costs_path() -> Path:
    """Return the cache file with the costs of this machine."""
    return cache_folder("previews") / "costs.json"


def known_costs(variant: Variant) -> tuple[PictureCosts, str]:
    """Return the measured costs of this machine, or else the shipped ones; and their source.

    The source is the end of a sentence.
    """
    shipped = shipped_table().costs
    path = machine_costs_path()
    try:
        record = read_json(path.read_bytes(), dict[str, Any], str(path))
        costs = from_record(PictureCosts, record)
        known = {(row.part, row.width) for row in costs.rows}
        for row in shipped.rows:
            if (row.part, row.width) not in known:
                raise TrilightError(
                    f"costs of previews: {row.part!r} at {row.width} pixels is missing; expected "
                    "each part at each width."
                )
    except FileNotFoundError:
        why = f"costs as shipped: `{MEASURE}` measures this machine"
    except (OSError, ValueError) as error:  # a TrilightError is one
        why = f"costs as shipped, since {path} cannot be used ({error}): `{MEASURE}` writes it anew"
    else:
        if costs.machine == machine_name(variant):
            return costs, "costs as measured here"
        why = (
            f"costs as shipped, since {path} is of another machine ({costs.machine}): "
            f"`{MEASURE}` measures this one"
        )
    return shipped, why


def keep_machine_costs(costs: PictureCosts) -> Path:
    """Write the costs of this machine, and return their file; raises TrilightError."""
    path = machine_costs_path()
    write_atomically(path, canonical_json(settings_record(costs)) + b"\n")
    return path


@dataclass(frozen=True)
class Budget:
    """The least expected error in some seconds a picture, or the least time to a median error."""

    option: Literal["--seconds", "--error"]
    limit: float
    """Wall-clock seconds a picture, or dB of psnr_log_db."""

    def __str__(self) -> str:
        """Return the option of the command line."""
        return f"{self.option} {self.limit:g}"


NETWORK = "the network builtin:tokens"

_LEAST_S = 1e-9
"""Lower bound of seconds, so that logarithms can be taken."""


@dataclass(frozen=True, kw_only=True)
class Priced:
    """Samples or the network, with expected cost and error at one width."""

    samples: PreviewSettings | None
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
    def sentence(self) -> str:
        """The choice as one line of text."""
        one = self.priced
        what = NETWORK
        if one.samples:
            what = f"{samples_text(one.samples.spp)} a pixel, filter {one.samples.denoiser}"
        lead = "chosen" if self.fits else "nothing is as quick; the quickest is chosen"
        seconds = f"{one.seconds:.2g}" if one.seconds < 10 else f"{one.seconds:.0f}"
        return (
            f"{self.budget}: {lead}: {what}; expected {one.db:.1f} dB in the "
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
    rows: dict[PreviewSettings | None, list[PreviewError]] = {}
    for row in table.errors:
        traced = None
        if row.rung == "traced":
            traced = PreviewSettings(resolution=width, spp=row.spp, denoiser=row.denoiser)
        if traced or network:
            rows.setdefault(traced, []).append(row)
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
            seconds = sum(count * part_s[name] for name, count in parts.items())
            seconds += part_s[SCENE] / per_scene
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


def choose(
    budget: Budget, candidates: Sequence[Priced], *, scenes: int, costs: str, width: int
) -> Choice:
    """Return the candidate of least error within the seconds, or the fastest with the error.

    Of equals it is the cheaper or the better one. Where none is as quick, it is the fastest one.

    Raises:
        TrilightError: none reaches the error.
    """
    limit = budget.limit
    by_time = budget.option == "--seconds"
    good = [one for one in candidates if (one.seconds <= limit if by_time else one.db >= limit)]
    if not good and not by_time:
        most = max(one.db for one in candidates)
        raise TrilightError(
            f"--error is {limit:g}; expected at most {math.floor(10 * most) / 10} dB at {width} "
            f"pixels, the most that previews reach; --noise-floor {limit:g} samples until the "
            "error is measured to be that."
        )
    if good and by_time:
        priced = max(good, key=lambda one: (one.db, -one.seconds))
    else:
        priced = min(good or candidates, key=lambda one: (one.seconds, -one.db))
    return Choice(budget=budget, priced=priced, fits=bool(good), scenes=scenes, costs=costs)


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

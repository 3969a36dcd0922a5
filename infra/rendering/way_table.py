"""What ways to a picture cost and how far they are from the truth: the tables that choices read.

Errors are shipped: they do not depend on the machine. Costs are shipped as well, as core-seconds of
the machine on which they were measured, until `trilight doctor --measure` has timed the same parts
on this one and keeps them in the user's cache.
"""

import functools
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from infra.processor import processor
from pipeline.renders.preview import MOST_SPP
from pipeline.renders.settings import Filtered, Resolution
from pipeline.renders.variant import Variant
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.metrics import MAX_DB
from storage.settings.described import checked, from_record, settings_record
from storage.settings.ranges import Within

SHIPPED = Path(__file__).with_name("previews.json")
"""Measured and written by infra.setup.preview_table."""

NETWORK_SCENE = "network scene"
NETWORK_VIEW = "network view"
"""Parts of a picture of the network builtin:tokens, beside pipeline.renders.preview_parts."""

MEASURE = "trilight doctor --measure"
"""Writes the costs of this machine."""

Rung = Literal["traced", "network"]
"""Few samples and a filter, or the network builtin:tokens, whose further views cost the least."""

Seconds = Annotated[float, Within(0, 1e6, unit="seconds")]
Decibels = Annotated[float, Within(-MAX_DB, MAX_DB, unit="dB")]


@checked("costs of a part")
class PartCost:
    """What one part of a picture takes at a width: `serial_s` + `parallel_s` / threads."""

    part: str
    """Its name."""
    width: Resolution
    """Width of the picture in pixels."""
    serial_s: Seconds
    """Seconds that more threads do not shorten."""
    parallel_s: Seconds
    """Core-seconds that threads share."""


@checked("costs of previews")
class PictureCosts:
    """What the parts of pictures take on a machine."""

    machine: str
    """Processor, cores and variant of Mitsuba."""
    rows: tuple[PartCost, ...]
    """Each part at each width."""


@checked("errors of a way")
class WayError:
    """How far the pictures of one way are from the truth at a width."""

    rung: Rung
    """Traced, or by the network."""
    spp: Annotated[int, Within(0, MOST_SPP, unit="samples")]
    """Samples per pixel; 0 of the network."""
    denoiser: Filtered
    """Filter; off with the network."""
    width: Resolution
    """Width of the pictures in pixels."""
    median_db: Decibels
    """Median psnr_log_db over the scenes, against raw references."""
    least_db: Decibels
    """That of the worst scene."""


@checked("the table of previews")
class WayTable:
    """All ways that are shipped."""

    scenes: Annotated[int, Within(1, 1_000_000, unit="scenes")]
    """Number of scenes, one view each."""
    errors: tuple[WayError, ...]
    """Each way at the widths at which it was measured."""
    costs: PictureCosts
    """Median core-seconds of the parts, one thread."""
    probe: PictureCosts
    """The same of the mean of the first scenes alone, which other machines time as well."""


@dataclass(frozen=True, kw_only=True)
class KnownCosts:
    """The costs that hold here, and where they are from."""

    costs: PictureCosts
    source: str
    """Where they are from, as the end of a sentence."""


@functools.cache
def shipped_table() -> WayTable:
    """Return the table that comes with Trilight."""
    return from_record(WayTable, json.loads(SHIPPED.read_bytes()))


def machine_name(variant: Variant) -> str:
    """Return what costs depend on."""
    return f"{processor()}, {os.cpu_count()} cores, {variant.name}"


def machine_costs_path() -> Path:
    """Return where the costs of this machine are kept."""
    return cache_folder("previews") / "costs.json"


def known_costs(variant: Variant) -> KnownCosts:
    """Return the costs of this machine where they were measured, else those that are shipped."""
    shipped = shipped_table().costs
    path = machine_costs_path()
    try:
        record: Any = json.loads(path.read_bytes())
        costs = from_record(PictureCosts, record)
        _require_whole(costs, shipped)
    except FileNotFoundError:
        why = f"costs as shipped: `{MEASURE}` measures this machine"
    except (OSError, ValueError) as error:  # a TrilightError and undecodable JSON are such
        why = f"costs as shipped, since {path} cannot be used ({error}): `{MEASURE}` writes it anew"
    else:
        if costs.machine == machine_name(variant):
            return KnownCosts(costs=costs, source="costs as measured here")
        why = (
            f"costs as shipped, since {path} is of another machine ({costs.machine}): "
            f"`{MEASURE}` measures this one"
        )
    return KnownCosts(costs=shipped, source=why)


def keep_machine_costs(costs: PictureCosts) -> Path:
    """Keep costs as those of this machine and return their file; TrilightError as of files."""
    path = machine_costs_path()
    write_atomically(path, canonical_json(settings_record(costs)) + b"\n")
    return path


def _require_whole(costs: PictureCosts, shipped: PictureCosts) -> None:
    known = {(row.part, row.width) for row in costs.rows}
    for row in shipped.rows:
        if (row.part, row.width) not in known:
            raise TrilightError(
                f"costs of previews: {row.part!r} at {row.width} pixels is missing; expected each "
                "part at each width."
            )

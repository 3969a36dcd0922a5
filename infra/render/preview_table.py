"""Tables of cost and error of previews, for `trilight render --seconds` and `--error`.

Errors are shipped: they do not depend on the machine. Costs are shipped as well, as CPU seconds of
the machine on which they were measured; `trilight doctor --measure` times the same parts on this
machine and writes them into the user's cache.
"""

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from infra.processor import processor
from pipeline.renders.mitsuba_variant import Variant
from pipeline.renders.preview import MOST_SPP
from pipeline.renders.settings import Filtered, Resolution
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.machine import available_cores
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


@dataclass(frozen=True, kw_only=True)
class KnownCosts:
    """Costs that apply to this machine, and their source."""

    costs: PictureCosts
    source: str
    """Source of the costs, as the end of a sentence."""


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


def known_costs(variant: Variant) -> KnownCosts:
    """Return the measured costs of this machine, or the shipped ones without a measurement."""
    shipped = shipped_table().costs
    path = machine_costs_path()
    try:
        record = read_json(path.read_bytes(), dict[str, Any], str(path))
        costs = from_record(PictureCosts, record)
        _require_whole(costs, shipped)
    except FileNotFoundError:
        why = f"costs as shipped: `{MEASURE}` measures this machine"
    except (OSError, ValueError) as error:  # a TrilightError is one
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
    """Write the costs of this machine, and return their file; raises TrilightError."""
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

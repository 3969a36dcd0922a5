"""The path tracer in the network's own time, as an evaluation tells of it.

No picture is traced here: whoever may do so (infra.tracer_rival) gives the pictures and the times.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from storage.records.sample import Sample
from train.evaluation.judged_view import NETWORK, JudgedView, summary
from train.evaluation.pairs import pair

TRACER = "path tracer, same time"
"""Name of the contestant."""

CAPTION = "path tracer"
"""Its name on sheets, where there is less room."""


@dataclass(frozen=True, kw_only=True)
class TracerTimes:
    """What the path tracer does in that time."""

    samples: int
    """Samples a pixel."""
    denoiser: str
    """The filter."""
    first_s: float
    """Core-seconds of the first view of a scene."""
    further_s: float
    """And of a further view."""
    note: str
    """What a person should know of the machine's tracer; empty if nothing."""


@dataclass(frozen=True, kw_only=True)
class Times:
    """What was timed, on one thread of a processor once everything was warm; medians."""

    network_first_s: float
    """Core-seconds of the network for the first view of a scene."""
    network_further_s: float
    """And for a further view."""
    scenes: int
    """Scenes that were timed."""
    preview: TracerTimes | None
    """None where nothing is traced."""
    missing: str = ""
    """Why nothing is."""


class TracedBeside(Protocol):
    """Who traces pictures of stored scenes for an evaluation."""

    def judged(self, sample: Sample, view: int) -> NDArray | None:
        """Return linear radiance [R, R, 3], or None of a view that it is not judged on."""

    def shown(self, sample: Sample, view: int) -> NDArray | None:
        """Return the same of any view; None where it cannot be traced."""

    def close(self) -> None:
        """End what is held; a later picture begins anew."""


def same_time(views: Sequence[JudgedView], times: Times, which: str) -> dict[str, Any]:
    """Return network and path tracer over the views that have both, as JSON values.

    Args:
        views: the rows.
        times: of both.
        which: says which views the tracer was judged on.
    """
    both = [view for view in views if TRACER in view.scores]
    found = dataclasses.asdict(times) | {"which": which, "views": len(both)}
    if times.preview is None:
        return found
    if not both:
        return found | {"missing": "none of the judged views could be traced"}
    lead = pair(both, NETWORK, TRACER)
    return found | {
        "network": summary(both, NETWORK),
        "tracer": summary(both, TRACER),
        "lead_db": {"mean": lead.mean, "low": lead.low, "high": lead.high},
        "share_better": lead.share_better,
    }


def sentences(found: Mapping[str, Any]) -> list[str]:
    """Return what a person reads of it."""
    own = (
        f"A further view takes the network {found['network_further_s']:.3g} core-seconds, the "
        f"first of a scene {found['network_first_s']:.3g} (medians of {found['scenes']} scenes, "
        "one thread of a processor)."
    )
    if found["missing"]:
        return [own, f"The path tracer in that time is not shown: {found['missing']}."]
    preview, lead = found["preview"], found["lead_db"]
    longer = preview["further_s"] > found["network_further_s"]
    lines = [
        own,
        f"The path tracer takes {preview['further_s']:.3g} ({preview['first_s']:.3g}) with "
        f"{preview['samples']} sample{'s' if preview['samples'] > 1 else ''} a pixel and its "
        f"{preview['denoiser']} filter"
        f"{': longer than the network, and it has nothing cheaper' if longer else ''}.",
        f"Over {found['views']} views ({found['which']}) the network has "
        f"{found['network']['psnr_log_db']['median']:.2f} dB and the path tracer "
        f"{found['tracer']['psnr_log_db']['median']:.2f} dB, medians of psnr_log_db; view by view "
        f"the network less the path tracer is {lead['mean']:+.2f} dB ({_interval(lead)}), and the "
        f"network is better in {found['share_better']:.0%}.",
        "The targets went through the same denoiser, which favours the path tracer a little.",
    ]
    return [*lines, *([f"{preview['note']}."] if preview["note"] else [])]


def _interval(lead: Mapping[str, float | None]) -> str:
    if lead["low"] is None:
        return "no interval, of one scene"
    return f"{lead['low']:+.2f} to {lead['high']:+.2f}, 95 % by scene"

"""Report on the path tracer at equal time, within an evaluation.

No picture is traced here: infra.tracer_rival provides the pictures and the times.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from storage.records.sample import Sample
from train.evaluation.judged_view import NETWORK, JudgedView, summarize_views
from train.evaluation.pairs import paired_lead

TRACER = "path tracer, same time"
"""Name of the path tracer among the evaluated methods."""

CAPTION = "path tracer"
"""Short name of the path tracer on sheets."""


@dataclass(frozen=True, kw_only=True)
class TracerTimes:
    """Settings and times of the path tracer at equal time."""

    samples: int
    """Number of samples per pixel."""
    denoiser: str
    """Name of the denoiser's filter."""
    first_s: float
    """CPU seconds of the first view of a scene."""
    further_s: float
    """CPU seconds of each further view."""
    note: str
    """Remark about the machine's path tracer; empty if there is none."""


@dataclass(frozen=True, kw_only=True)
class SameTimeResult:
    """Median times on one CPU thread after a warm-up."""

    network_first_s: float
    """CPU seconds of the network for the first view of a scene."""
    network_further_s: float
    """CPU seconds of the network for each further view."""
    scenes: int
    """Number of scenes that were timed."""
    preview: TracerTimes | None
    """Times of the path tracer; None if nothing is traced."""
    missing: str = ""
    """Reason why nothing is traced; empty otherwise."""


class TracedBeside(Protocol):
    """Source of traced pictures of stored scenes for an evaluation."""

    def judged(self, sample: Sample, view: int) -> NDArray | None:
        """Return linear radiance [R, R, 3], or None for a view that is not scored."""

    def shown(self, sample: Sample, view: int) -> NDArray | None:
        """Return linear radiance [R, R, 3] of any view, or None if it cannot be traced."""

    def close(self) -> None:
        """Release all resources; a later picture allocates them again."""


def same_time(views: Sequence[JudgedView], times: SameTimeResult, which: str) -> dict[str, Any]:
    """Compare network and path tracer over the views that have both, as JSON values.

    Args:
        views: rows of the evaluation.
        times: times of both.
        which: description of the views that the tracer was scored on.
    """
    both = [view for view in views if TRACER in view.scores]
    figures = dataclasses.asdict(times) | {"which": which, "views": len(both)}
    if times.preview is None:
        return figures
    if not both:
        return figures | {"missing": "none of the judged views could be traced"}
    lead = paired_lead(both, NETWORK, TRACER)
    return figures | {
        "network": summarize_views(both, NETWORK),
        "tracer": summarize_views(both, TRACER),
        "lead_db": {"mean": lead.mean, "low": lead.low, "high": lead.high},
        "share_better": lead.share_better,
    }


def sentences(figures: Mapping[str, Any]) -> list[str]:
    """Return the comparison as sentences."""
    network_sentence = (
        f"A further view takes the network {figures['network_further_s']:.3g} core-seconds, the "
        f"first of a scene {figures['network_first_s']:.3g} (medians of {figures['scenes']} "
        "scenes, one thread of a processor)."
    )
    if figures["missing"]:
        return [
            network_sentence,
            f"The path tracer in that time is not shown: {figures['missing']}.",
        ]
    preview = figures["preview"]
    lead = figures["lead_db"]
    longer = preview["further_s"] > figures["network_further_s"]
    lines = [
        network_sentence,
        f"The path tracer takes {preview['further_s']:.3g} ({preview['first_s']:.3g}) with "
        f"{preview['samples']} sample{'s' if preview['samples'] > 1 else ''} a pixel and its "
        f"{preview['denoiser']} filter"
        f"{': longer than the network, and it has nothing cheaper' if longer else ''}.",
        f"Over {figures['views']} views ({figures['which']}) the network has "
        f"{figures['network']['psnr_log_db']['median']:.2f} dB and the path tracer "
        f"{figures['tracer']['psnr_log_db']['median']:.2f} dB, medians of psnr_log_db; view by "
        f"view the network less the path tracer is {lead['mean']:+.2f} dB ({_interval(lead)}), "
        f"and the network is better in {figures['share_better']:.0%}.",
        "The targets went through the same denoiser, which favours the path tracer a little.",
    ]
    return [*lines, *([f"{preview['note']}."] if preview["note"] else [])]


def _interval(lead: Mapping[str, float | None]) -> str:
    if lead["low"] is None:
        return "no interval, of one scene"
    return f"{lead['low']:+.2f} to {lead['high']:+.2f}, 95 % by scene"

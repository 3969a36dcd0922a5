"""The path tracer in the network's own time, as an evaluation tells of it.

No picture is traced here: whoever may do so (infra.tracer_rival) gives the pictures and the times.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from storage.intervals import mean_interval
from storage.records.sample import Sample
from train.evaluation.judged_view import NETWORK, JudgedView, summary

TRACER = "path tracer, same time"
"""Name of the contestant."""


@dataclass(frozen=True, kw_only=True)
class Times:
    """What was timed, on one thread of a processor once everything was warm; medians."""

    samples: int
    """Samples a pixel of the path tracer."""
    denoiser: str
    """Its filter."""
    tracer_first_s: float
    """Core-seconds of the path tracer for the first view of a scene."""
    tracer_further_s: float
    """And for a further view."""
    network_first_s: float
    """Core-seconds of the network for the first view of a scene."""
    network_further_s: float
    """And for a further view."""
    scenes: int
    """Scenes that were timed."""
    note: str
    """What a person should know of the machine's tracer; empty if nothing."""

    @property
    def fits(self) -> bool:
        """Whether the tracer's further view takes no longer than the network's."""
        return self.tracer_further_s <= self.network_further_s


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
    found = dataclasses.asdict(times) | {"fits": times.fits, "which": which, "views": len(both)}
    if not both:
        return found | {"missing": "none of the judged views could be traced"}
    leads_db = [
        (view.scores[NETWORK]["psnr_log_db"] or 0.0) - (view.scores[TRACER]["psnr_log_db"] or 0.0)
        for view in both
    ]
    low, high = mean_interval(leads_db, [view.key for view in both])
    return found | {
        "network": summary(both, NETWORK),
        "tracer": summary(both, TRACER),
        "lead_db": {"mean": float(np.mean(leads_db)), "low": low, "high": high},
        "share_better": float(np.mean(np.array(leads_db) > 0)),
    }


def sentences(found: Mapping[str, Any] | None) -> list[str]:
    """Return what a person reads of it; nothing where nobody asked."""
    if found is None:
        return []
    if "missing" in found:
        return [f"The path tracer in the network's time is not shown: {found['missing']}."]
    plural = "s" if found["samples"] > 1 else ""
    fits = "" if found["fits"] else ", longer than the network, and nothing traced is cheaper"
    median = {name: found[name]["psnr_log_db"]["median"] for name in ("network", "tracer")}
    lead = found["lead_db"]
    lines = [
        f"A further view takes the network {found['network_further_s']:.3g} core-seconds (the "
        f"first of a scene {found['network_first_s']:.3g}), and the path tracer with "
        f"{found['samples']} sample{plural} a pixel and its {found['denoiser']} filter "
        f"{found['tracer_further_s']:.3g} ({found['tracer_first_s']:.3g}){fits}: medians of "
        f"{found['scenes']} scenes, one thread of a processor.",
        f"Over {found['views']} views ({found['which']}) the network has {median['network']:.2f} "
        f"dB and the path tracer {median['tracer']:.2f} dB, medians of psnr_log_db; view by view "
        f"the network is better by {lead['mean']:+.2f} dB ({lead['low']:+.2f} to "
        f"{lead['high']:+.2f}, 95 % by scene), and better in {found['share_better']:.0%}. The "
        "targets went through the same denoiser, which favours the path tracer a little.",
    ]
    return [*lines, *([f"{found['note']}."] if found["note"] else [])]

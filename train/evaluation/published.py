"""What RenderFormer's paper reports, to stand beside a network's figures on `benchmark-v1`."""

from collections.abc import Mapping, Sequence
from typing import Any

from train.evaluation.groups import summary
from train.evaluation.judged_view import JudgedView

BENCHMARK = "benchmark-v1"
"""The public test set (pipeline.builds.judging)."""

PUBLISHED = {"psnr_linear_db": 29.77, "ssim": 0.9526, "lpips": 0.0551, "hdr_flip": 0.1751}
"""Zeng et al. 2025, Table 1: means over 400 scenes of four views each, 256 x 256."""

PUBLISHED_WHERE = (
    "The paper's figures (Zeng et al. 2025, Table 1) are of 400 scenes of its own with four views "
    "each at 256 x 256, which were never released, and it does not say how it tone-mapped: same "
    "kind of set, not the same set."
)


def published_beside(
    views: Sequence[JudgedView], about: Mapping[str, Any]
) -> dict[str, dict[str, float | None]] | None:
    """Return the published figures and the network's means, if `about` says it is BENCHMARK."""
    if about.get("build") != BENCHMARK:
        return None
    network = summary(views)
    return {
        metric: {"published": figure, "ours": network[metric]["mean"]}
        for metric, figure in PUBLISHED.items()
    }

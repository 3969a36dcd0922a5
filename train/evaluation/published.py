"""Scores from the RenderFormer paper, measured on its own unreleased scenes."""

from collections.abc import Mapping

BENCHMARK = "benchmark-v1"
"""Name of our public test set (pipeline.builds.judging)."""

_METRICS = ("psnr_linear_db", "ssim", "lpips", "hdr_flip")

_SHOWN = {
    "RenderFormer, 12 + 6 layers, 205 M (the paper's)": (29.77, 0.9526, 0.0551, 0.1751),
    "9 + 9 layers": (30.11, 0.9554, 0.0512, 0.1735),
    "6 + 12 layers": (30.38, 0.9560, 0.0504, 0.1685),
    "view stage in world space": (28.98, 0.9420, 0.0631, 0.1904),
    "without DPT": (29.75, 0.9476, 0.0552, 0.1806),
    "without self-attention of rays": (29.70, 0.9503, 0.0570, 0.1766),
    "without either": (29.15, 0.9396, 0.0641, 0.1836),
}

PUBLISHED_ROWS: Mapping[str, Mapping[str, float]] = {
    name: dict(zip(_METRICS, figures, strict=True)) for name, figures in _SHOWN.items()
}
"""Zeng et al. 2025, Table 1: means over 400 scenes of four views each, 256 x 256."""

PUBLISHED = next(iter(PUBLISHED_ROWS.values()))
"""Scores of the network whose weights were published."""

PUBLISHED_WHERE = (
    "The paper's figures (Zeng et al. 2025, Table 1) are of 400 scenes of its own with four views "
    "each at 256 x 256, which were never released, and it does not say how it tone-mapped: same "
    "kind of set, not the same set."
)

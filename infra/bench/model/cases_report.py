"""The cases for people: rows with both ratios and the memory, and a figure with their aims."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt
import torch

from infra.bench.harness import Comparison, Spread
from infra.bench.model.cases import matmul_name, side_name
from infra.bench.model.contenders import DEFAULT, EQUAL, PUBLISHED
from infra.bench.model.training import TRAINING, peak_tflops
from infra.bench.renders.log_axis import plain_log

EQUAL_AIMS = {"full": 1.0, "median": 2.0, "plane-only": 5.0}
"""Times faster than the published forward pass, in float32."""
SHARE_AIM, MEMORY_AIM, DB_AIM = 0.6, 0.5, 50.0
"""Of the machine's matmul ratio; of the published peak memory; of bfloat16 against float32."""

Figures = Mapping[str, Spread]


def cases_of(result: Comparison) -> list[str]:
    """Return the names of the cases."""
    return [
        name.removesuffix(f": {PUBLISHED}") for name in result.sides if name.endswith(PUBLISHED)
    ]


def cost_name(result: Comparison) -> str:
    """Return the figure that is compared: core-seconds, or on CUDA the clock."""
    return "seconds" if TRAINING in result.sides else "core_s"


def ratios(result: Comparison, case: str) -> dict[str, float]:
    """Return what a case is judged by; each is larger or smaller than one of the aims."""
    cost = cost_name(result)
    published, equal, default = _three(result, case)
    matmul = matmul_ratio(result)
    more = equal[cost].median / default[cost].median
    return {
        "equal": published[cost].median / equal[cost].median,
        "default": published[cost].median / default[cost].median,
        "more": more,
        "share": more / matmul,
        "memory equal": equal["memory_bytes"].median / published["memory_bytes"].median,
        "memory default": default["memory_bytes"].median / published["memory_bytes"].median,
    }


def matmul_ratio(result: Comparison) -> float:
    """Return how many times faster the machine multiplies in bfloat16."""
    cost = cost_name(result)
    float32, bfloat16 = (result.sides[matmul_name(name)][cost] for name in (EQUAL, DEFAULT))
    return float32.median / bfloat16.median


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    float32, bfloat16 = (result.sides[matmul_name(name)] for name in (EQUAL, DEFAULT))
    lines = [
        (
            "matmul",
            f"float32 {float32['gflop_per_s'].median:.0f}, bfloat16 "
            f"{bfloat16['gflop_per_s'].median:.0f} GFLOP/s: {matmul_ratio(result):.2f} x",
        )
    ]
    for case in cases_of(result):
        lines += _case_rows(result, case)
    if TRAINING in result.sides:
        lines.append((TRAINING, _of_peak(result.sides[TRAINING]["gflop_per_s"].median)))
    return lines


def _case_rows(result: Comparison, case: str) -> list[tuple[str, str]]:
    published, equal, default = _three(result, case)
    found = ratios(result, case)
    lines = [
        (case, f"published {_said(published)}"),
        (
            "  float32",
            f"{_said(equal)}: {found['equal']:.2f} x faster, memory "
            f"{found['memory equal']:.2f}; differs by {equal['difference'].median:.1e}",
        ),
        (
            "  bfloat16",
            f"{_said(default)}: {found['default']:.2f} x faster, {found['more']:.2f} x float32 "
            f"({found['share']:.0%} of matmul's), memory {found['memory default']:.2f}; "
            f"{default['psnr_log_db'].median:.1f} dB",
        ),
    ]
    if TRAINING in result.sides:
        rate = default["gflop"].median / default["seconds"].median
        lines.append(("  bfloat16, of the device", _of_peak(rate)))
    return lines


def _said(figures: Figures) -> str:
    wall, core = figures["seconds"], figures["core_s"]
    return (
        f"{wall.median:.2f} s ({wall.low:.2f} to {wall.high:.2f}), {core.median:.2f} core-s "
        f"({core.low:.2f} to {core.high:.2f}), {figures['memory_bytes'].median / 1e6:.0f} MB"
    )


def _of_peak(gflop_per_s: float) -> str:
    peak = peak_tflops(torch.device("cuda"))
    share = f", {gflop_per_s / 1000 / peak:.0%} of {peak:.0f}" if peak else ", peak unknown"
    return f"{gflop_per_s / 1000:.1f} TFLOP/s{share}"


def _three(result: Comparison, case: str) -> tuple[Figures, Figures, Figures]:
    published, equal, default = (
        result.sides[side_name(case, side)] for side in (PUBLISHED, EQUAL, DEFAULT)
    )
    return published, equal, default


def plot(result: Comparison, path: Path) -> None:
    """Draw how many times faster, and the share of memory, with the aims as lines."""
    names = cases_of(result)
    found = [ratios(result, case) for case in names]
    height = 1.6 + 0.45 * len(names)
    figure, (speed, memory) = plt.subplots(
        1, 2, figsize=(11, height), layout="constrained", sharey=True
    )
    for shift, side, colour in ((-0.2, "equal", "C0"), (0.2, "default", "C1")):
        places = [row + shift for row in range(len(names))]
        words = {"equal": "float32", "default": "bfloat16"}[side]
        speed.barh(places, [one[side] for one in found], 0.38, color=colour, label=words)
        memory.barh(places, [one[f"memory {side}"] for one in found], 0.38, color=colour)
    for row, (case, one) in enumerate(zip(names, found, strict=True)):
        aim = EQUAL_AIMS[case.split(",")[0]]
        wanted = (aim, one["equal"] * SHARE_AIM * matmul_ratio(result))
        for shift, x in zip((-0.2, 0.2), wanted, strict=True):
            speed.plot([x, x], [row + shift - 0.19, row + shift + 0.19], "k", linewidth=2)
    memory.axvline(MEMORY_AIM, color="k", linewidth=2, label="aim")
    speed.plot([], [], "k", linewidth=2, label="aim")
    speed.set_yticks(range(len(names)), names)
    speed.invert_yaxis()
    speed.set_xscale("log")
    plain_log(speed.xaxis, (1, 2, 5))
    speed.set_xlabel("times faster than the published forward pass")
    memory.set_xlabel("peak memory beyond the weights, as a share of its")
    for axes in (speed, memory):
        axes.grid(axis="x", alpha=0.3)
    speed.legend(loc="upper right")
    figure.suptitle(
        f"205 M parameters, matmul in bfloat16 {matmul_ratio(result):.1f} x, {result.date}"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)

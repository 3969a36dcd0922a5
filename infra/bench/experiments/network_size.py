"""What the size of a network costs, and what small trainings say that it is worth."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one, repeats
from infra.bench.experiments.network import CORE_S
from infra.bench.machine import ROOT
from infra.bench.workshop import Workshop

if TYPE_CHECKING:
    from model.config import ModelConfig

TRAININGS = ROOT / "docs" / "bench" / "training_table.jsonl"
"""Results of small trainings (docs/log); what a size is worth comes from there."""
TABLE_WIDTHS: Mapping[str, int] = {"table, small": 64, "table, large": 128}
SIZES = (*TABLE_WIDTHS, "tiny", "smoke", "small", "base", "large")


def _size(workshop: Workshop, point: Point, turn: str) -> Figures:
    """Measure the time of one size; its error is that of small trainings, where there are any."""
    from infra.bench.sides.networks import (
        CPU,
        forward_of,
        random_network,
        timed_forward,
        workload_of,
    )
    from model.renderformer import count_parameters

    config, workload = _config(point.name), workload_of(workshop.effort)
    least = max(workload.resolution, config.picture_px)  # some sizes have windows of ray bundles
    model = random_network(config)
    forward = forward_of(model, dataclasses.replace(workload, resolution=least))
    _, figures = timed_forward(forward, CPU)
    return {**figures, "parameters": count_parameters(model) / 1e6, **trained_scores(point.name)}


def _config(name: str) -> "ModelConfig":
    from model.config import SIZES

    if name not in TABLE_WIDTHS:
        return SIZES[name]()
    width = TABLE_WIDTHS[name]
    return dataclasses.replace(
        SIZES["smoke"](),
        width=width,
        num_heads=width // 64,
        hidden_width=3 * width,
        encoder_layers=2,
        decoder_layers=2,
    )


def trained_scores(size: str, path: Path = TRAININGS) -> dict[str, float]:
    """Return how small trainings of one size ended on the largest set, means over seeds."""
    lines = path.read_text().splitlines() if path.is_file() else []
    rows = [
        row for row in map(json.loads, lines) if (row["change"], row["plan"]) == ("ours", "cpu")
    ]
    most = max((row["scenes"] for row in rows), default=0)
    mine = [r for r in rows if r["scenes"] == most and f"table, {r['size']}" == size]
    if not mine:
        return {}
    return {
        "log_l1": float(np.mean([row["scores"]["log_l1"] for row in mine])),
        "trained_db": float(np.mean([row["scores"]["psnr_log_db_median"] for row in mine])),
        "steps": float(np.mean([row["num_steps"] for row in mine])),
    }


_MODEL = ("width", "num_heads", "encoder_layers", "decoder_layers", "hidden_width", "head",
          "dpt_features", "dpt_channels", "dpt_taps")  # fmt: skip

EXPERIMENTS = (
    Experiment(
        name="size",
        title="Size of the network",
        about="One view of a full scene by networks with random weights.",
        covers=tuple(f"train.model.{name}" for name in _MODEL),
        cost=CORE_S,
        error=Column(name="held-out log L1 of small trainings", figure="log_l1"),
        against="held-out pictures of the same set, after equally many views. Only the sizes of "
        "the table of small trainings were trained on one set for one number of steps. The others "
        "are n/a and show their cost alone: the shipped network (`smoke`) was trained for longer, "
        "which would be read as a gain of its size, and larger ones were never trained",
        columns=(
            Column(name="M parameters", figure="parameters"),
            Column(name="psnr_log_db, median", figure="trained_db"),
            Column(name="steps", figure="steps"),
        ),
        because="Default: `base` where the paper is to be repeated, `smoke` on two cores. What a "
        "size is worth depends on the data (docs/log).",
        points=lambda effort: [Point(name=name, default=name == effort.network) for name in SIZES],
        turns=repeats,
        measure=one_by_one(_size),
        needs=("torch",),
    ),
)

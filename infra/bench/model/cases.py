"""Our network against the published forward pass, on the same weights and scenes.

Two ratios for each case, never one: at equal precision, which shows what structure saves, and in
bfloat16, beside what bfloat16 gives this machine's matrix products. Sides take turns. A processor's
seconds are core-seconds, which other work stretches less than the clock.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from infra.bench.harness import Comparison, Options, Spread, compare
from infra.bench.model.contenders import (
    DEFAULT,
    EQUAL,
    PUBLISHED,
    SIDES,
    Contenders,
    Forward,
    published_like,
)
from infra.bench.model.memory import peaks_of
from infra.bench.model.network_errors import log10_psnr_db
from infra.bench.model.training import TRAINING, training_step
from infra.bench.model.workloads import cases
from model.config import ModelConfig
from model.costs import Workload, flops
from model.published.config import PublishedConfig, decode_published

NAME = "model-cases"
MATMUL = {"float32": torch.float32, "bfloat16": torch.bfloat16}
"""Matrix products that are measured beside the networks."""
_MATMULS = 20

Figures = Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is measured."""

    config: PublishedConfig
    """The network."""
    workloads: Mapping[str, Workload]
    """Cases by name."""
    repeats: int
    """Counted rounds."""


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure; quickly Base at 256 pixels in 2 rounds, otherwise at 512 too in 5."""
    return measure(_plan(options), device(), round_done)


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return rounds_of(_plan(options), device())


def rounds_of(plan: Plan, on: torch.device) -> int:
    """Return how often `measure` calls `round_done`."""
    sides = len(SIDES) * len(plan.workloads) + len(MATMUL) + (on.type == "cuda")
    return sides * (1 + plan.repeats) + len(SIDES)


def device() -> torch.device:
    """Return the graphics card where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _plan(options: Options) -> Plan:
    return Plan(
        config=decode_published({}),
        workloads=cases(256) if options.quick else cases(256) | cases(512),
        repeats=2 if options.quick else 5,
    )


def side_name(case: str, side: str) -> str:
    """Return the name of a side of a case."""
    return f"{case}: {side}"


def matmul_name(precision: str) -> str:
    """Return the name of the side of bare matrix products."""
    return f"matmul {precision}"


def measure(plan: Plan, on: torch.device, round_done: Callable[[], None]) -> Comparison:
    """Return seconds, memory and errors of every side of every case."""
    contenders = Contenders(plan.config, SIDES, on)
    pictures: dict[str, Tensor] = {}
    sides: dict[str, Callable[[], Figures]] = {}
    for case, workload in plan.workloads.items():
        for side in SIDES:
            name = side_name(case, side)
            forward = contenders.prepared(side, workload)
            sides[name] = partial(_forward, forward, pictures, name, on)
    for precision in MATMUL:
        sides[matmul_name(precision)] = partial(_matmul, precision, plan.config.model, on)
    if on.type == "cuda":
        sides[TRAINING] = training_step(plan.config.model, on)
    timed = compare(NAME, sides, repeats=plan.repeats, round_done=round_done)
    further = _errors(plan, pictures)
    for side in SIDES:
        peaks = peaks_of(side, plan.config, list(plan.workloads.values()), on)
        for case, peak in zip(plan.workloads, peaks, strict=True):
            further[side_name(case, side)]["memory_bytes"] = peak
        round_done()
    return with_figures(timed, further)


def with_figures(result: Comparison, further: Mapping[str, Figures]) -> Comparison:
    """Return the result with more figures of its sides, which no repeat changes."""
    added = {
        side: {name: Spread(median=value, low=value, high=value) for name, value in figures.items()}
        for side, figures in further.items()
    }
    return dataclasses.replace(
        result, sides={side: {**old, **added.get(side, {})} for side, old in result.sides.items()}
    )


@torch.inference_mode()
def timed_forward(forward: Forward, on: torch.device) -> tuple[Tensor, Figures]:
    """Return a picture and the processor's seconds; on CUDA all of its work is done then."""
    began = time.process_time()
    picture = forward()
    if on.type == "cuda":
        torch.cuda.synchronize(on)
    return picture, {"core_s": time.process_time() - began}


def _forward(forward: Forward, pictures: dict[str, Tensor], name: str, on: torch.device) -> Figures:
    picture, figures = timed_forward(forward, on)
    pictures[name] = picture.cpu()
    return figures


@torch.inference_mode()
def _matmul(precision: str, config: ModelConfig, on: torch.device) -> Figures:
    """Return the rate of the products that the network is made of: tokens by its hidden layer."""
    tokens, wide, hidden = 1536, config.width, config.hidden_width
    x = torch.ones(tokens, wide, dtype=MATMUL[precision], device=on)
    weight = torch.ones(hidden, wide, dtype=MATMUL[precision], device=on)
    wall, core = time.perf_counter(), time.process_time()
    for _ in range(_MATMULS):
        torch.nn.functional.linear(x, weight)
    if on.type == "cuda":
        torch.cuda.synchronize(on)
    gflop = 2e-9 * _MATMULS * tokens * wide * hidden
    return {
        "gflop_per_s": gflop / (time.perf_counter() - wall),
        "core_s": time.process_time() - core,
    }


def _errors(plan: Plan, pictures: Mapping[str, Tensor]) -> dict[str, dict[str, float]]:
    """Return what the sides of each case differ by."""
    found: dict[str, dict[str, float]] = {}
    for case in plan.workloads:
        published, equal, default = (pictures[side_name(case, side)] for side in SIDES)
        difference = (published_like(equal) - published).abs().max().item()
        work = 1e-9 * sum(flops(plan.config.model, plan.workloads[case]).values())
        found[side_name(case, PUBLISHED)] = {}
        found[side_name(case, EQUAL)] = {"gflop": work, "difference": difference}
        rounding_db = log10_psnr_db(default, equal)
        found[side_name(case, DEFAULT)] = {"gflop": work, "psnr_log_db": rounding_db}
    return found

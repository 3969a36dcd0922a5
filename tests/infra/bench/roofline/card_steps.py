"""What is counted on the card that is not there, in a process of its own; each is one case."""

import torch
from torch import nn

from infra.bench.roofline.case import Case
from infra.bench.roofline.prediction import peak_bytes
from infra.bench.roofline.row import RooflineRow, roofline
from infra.bench.roofline.step import traced_step
from infra.bench.roofline.trace import Kernel, Traced, Tracer
from infra.fake_card.card import CARD, fake_card
from train.runs import changed_run

ROWS, WIDTH = 8, 64


def small_step(precision: str) -> Traced:
    """Return a step of the smallest network on two scenes of unequal length."""
    return traced_step(changed_run("smoke", {"precision": precision}), 2)


def known_block() -> tuple[Traced, int]:
    """Return what is seen of one rounded layer, and the most bytes that it holds."""
    with fake_card():
        layer, x = nn.Linear(WIDTH, WIDTH).to(CARD), torch.empty(ROWS, WIDTH, device=CARD)
        tracer = Tracer()
        with tracer.counting():
            with tracer.part("layer"), torch.autocast("cuda", torch.bfloat16):
                y = torch.relu(layer(x))
            y.sum().backward()
            torch.stack([y.sum(), y.mean()]).tolist()
            del y
    return tracer.traced, peak_bytes(tracer.traced)


def row(case: Case) -> RooflineRow:
    return roofline(case)


def names(kernels: list[Kernel]) -> set[str]:
    return {kernel.name for kernel in kernels}

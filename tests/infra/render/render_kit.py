"""What the tests of `trilight render` share: the command, its mistakes, and a small network."""

import json
from pathlib import Path
from typing import Any

import torch

from model.config import smoke
from model.weights import TrainedRange, encode_weights
from tests.command_line import trilight
from tests.model.kit import awake

SMALL = ("--resolution", "16", "--max-spp", "8", "--noise-floor", "90")


def render(*arguments: str | Path) -> dict[str, Any]:
    """Return what `trilight render --json` prints."""
    words = ["render", *(str(argument) for argument in arguments), *SMALL, "--json"]
    result = trilight(words)
    assert result.exit_code == 0, result.exception
    return dict(json.loads(result.output))


def mistake(*arguments: str | Path) -> str:
    """Return the one line that a mistake becomes."""
    return trilight(["render", *(str(argument) for argument in arguments)]).mistake


def write_network(path: Path, max_triangles: int | None = None, bias: float = 0.3) -> Path:
    """Write a network of the size `smoke` that nobody trained: its pictures are a pattern."""
    model = awake(smoke(), torch.float32)
    last = model.decoder.head.last
    assert last.bias is not None
    with torch.no_grad():
        last.weight *= 0.1
        last.bias.fill_(bias)
    known = None if max_triangles is None else TrainedRange(max_triangles=max_triangles)
    path.write_bytes(encode_weights(model, known))
    return path

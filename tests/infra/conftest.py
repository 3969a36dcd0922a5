"""What every test of `infra` may ask for."""

from pathlib import Path

import pytest

from storage.records.scene_file import encode_scene
from tests.scenes_by_hand import tiny_scene


@pytest.fixture
def children_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read, convert and trace in this process; that children do so too is tested beside."""
    from tests.infra.child_here import use_children_here

    use_children_here(monkeypatch)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """The file of the tiny scene, which has two cameras."""
    path = tmp_path / "tiny.safetensors"
    path.write_bytes(encode_scene(tiny_scene()))
    return path


def write_network(path: Path, max_triangles: int | None = None, bias: float = 0.3) -> Path:
    """Write a network of the size `smoke` that nobody trained: its pictures are a pattern."""
    from model.config import SIZES
    from model.weights import TrainedRange, encode_weights
    from tests.model.test_inference import network

    known = None if max_triangles is None else TrainedRange(max_triangles=max_triangles)
    path.write_bytes(encode_weights(network(SIZES["smoke"](), bias), known))
    return path

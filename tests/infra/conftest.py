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

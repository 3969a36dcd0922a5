"""The network that comes along, on scenes of objects that no training set holds."""

import json
from pathlib import Path

import pytest

from model.open import BUILTIN_TOKENS
from tests.end_to_end.conftest import Trilight

SCENES = (
    *("--objects", "builtin:benchmark-v1", "--scenes", "8", "--resolution", "64"),
    *("--noise-floor", "34", "--set", "renders.max_spp=64", "--set", "scenes.max_triangles=768"),
    *("--set", "assets.budgets=[600,420,300,200,120,70]", "--set", "splits.one_split=true"),
)
"""As its training scenes were made (`model/builtin/README.md`)."""


@pytest.mark.slow("training")
def test_its_pictures_come_from_the_scene_it_is_shown(trilight: Trilight, tmp_path: Path) -> None:
    made = trilight("generate", "smoke", *SCENES, "--out", "set")
    assert made.returncode == 0, made.stderr
    judged = trilight(
        "evaluate", BUILTIN_TOKENS, "--data", "set", "--split", "test", "--out", "judged"
    )
    assert judged.returncode == 0, judged.stderr
    found = json.loads((tmp_path / "judged/evaluation.json").read_text())
    swapped = found["swapped scenes"]
    assert swapped["views"] == 4 * 7
    # the triangles of another scene, judged against this one's picture
    assert swapped["median_db"] > 3

"""`object-views` from objects to exports, and `olat` with the page that relights its scenes."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.exchange.exports.pictures import stands_alone
from storage.conventions import preview_srgb8
from storage.dataset.dataset import open_dataset
from storage.records.lights import num_light_pictures, sum_of_lights
from storage.records.passes.pictures import view_passes
from tests.command_line import run_program, trilight
from tests.conftest import ROOT
from tests.end_to_end.production_kit import SIXTEEN_SAMPLES
from tests.foreign_packages import foreign_packages, nerfstudio_pictures

ONE_VIEW = ("--set", "scenes.num_views=1")


def _generate(out: Path, *words: str) -> None:
    fewer = ["--resolution", "32", "--set", "splits.scenes_per_shard=2", *SIXTEEN_SAMPLES]
    result = trilight(["generate", *words, "--objects", "builtin:6", *fewer, "--out", str(out)])
    assert result.exit_code == 0, result.exception


@pytest.mark.slow("commands")
def test_objects_alone_from_the_preset_to_the_exports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path, str(foreign_packages())])
    made = tmp_path / "views"
    views = ["--set", "scenes.num_views=12", "--set", "scenes.skies.maps.height=16"]
    _generate(made, "object-views", "--scenes", "2", *views)
    result = trilight(["verify", str(made)])
    assert result.exit_code == 0, result.exception
    for sample in open_dataset(str(made)).samples("train"):
        assert stands_alone(sample.scene)
        assert [row.kind for row in sample.scene.objects] == ["object"]
        distance = np.linalg.norm(sample.scene.c2w[:, :3, 3], axis=1)
        np.testing.assert_allclose(distance, 1.6, rtol=1e-5)
        towards = sample.scene.c2w[:, :3, 3] / distance[:, None]
        heights = np.sort(towards[:, 2])
        np.testing.assert_allclose(np.diff(heights), 2 / 12, rtol=1e-3)  # equal areas
        seen = np.linalg.norm(sample.scene.vertex_positions, axis=1)
        assert seen.max() == pytest.approx(0.5, rel=0.05)
    out = tmp_path / "nerfstudio"
    result = trilight(["export", str(made), "--form", "nerfstudio", "--out", str(out)])
    assert result.exit_code == 0, result.exception
    for sample in open_dataset(str(made)).samples("train"):
        for view, rgba in nerfstudio_pictures(out / sample.key, sample).items():
            covered = view_passes(
                sample.scene, ["coverage"], view=view, resolution=32, rays_a_side=4
            )["coverage"]
            assert rgba.shape == (32, 32, 4) and {0.0, 1.0} < set(np.unique(covered))
            np.testing.assert_allclose(rgba[..., 3], np.round(255 * covered) / 255, rtol=1e-6)


@pytest.mark.slow("commands")
def test_the_page_relights_a_scene_one_light_at_a_time(tmp_path: Path) -> None:
    skies = ["--set", "scenes.skies.share=1", "--set", "scenes.skies.maps.height=16"]
    _generate(tmp_path / "data/olat", "olat", "--scenes", "1", *ONE_VIEW, *skies)
    assert trilight(["verify", str(tmp_path / "data/olat")]).exit_code == 0
    (block,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "docs/how-to/olat.md").read_text(), re.DOTALL
    )
    assert len([line for line in block.splitlines() if line.strip()]) <= 10
    (tmp_path / "block.py").write_text(block)
    printed = run_program([sys.executable, "block.py"], tmp_path).stdout
    (sample,) = open_dataset(str(tmp_path / "data/olat")).samples("train")
    assert sample.lights_rgb is not None and sample.views[0].lights is not None
    lights = sample.lights_rgb[0]
    assert len(lights) == num_light_pictures(sample.scene) > 2
    np.testing.assert_array_equal(sum_of_lights(lights), sample.radiance_rgb[0])
    assert json.loads(printed) == [floor.noise_floor_db for floor in sample.views[0].lights]
    relit = lights[0] * np.array([4, 1, 0.2], np.float32) + np.float32(0.25) * lights[1:].sum(
        axis=0
    )
    with Image.open(tmp_path / "relit.png") as picture:
        difference = np.asarray(picture).astype(int) - preview_srgb8(relit)
    assert np.abs(difference).max() <= 1

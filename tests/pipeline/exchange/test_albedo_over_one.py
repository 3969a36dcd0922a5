"""A RenderFormer scene whose albedos add up to more than 1, as a command reads it."""

import json
import shutil
from pathlib import Path

import pytest

from pipeline.exchange.open_scene import load_source, scene_source
from storage.errors import TrilightError


def test_albedos_beyond_one_are_scaled_with_a_note_or_refused(shared: Path, tmp_path: Path) -> None:
    """1.1 as the background of one published scene has it: one factor for both and all channels."""
    source = shared / "renderformer_scenes"
    for name in ("objects", "templates"):
        shutil.copytree(source / name, tmp_path / name)
    described = json.loads((source / "crystals.json").read_text())
    (tmp_path / "lawful.json").write_text(json.dumps(described))
    change = {"rand_tri_diffuse_seed": None, "diffuse": [0.6, 0.3, 0.0], "specular": [0.5] * 3}
    described["objects"]["background_0"]["material"] |= change
    path = tmp_path / "bright.json"
    path.write_text(json.dumps(described))
    loaded = load_source(scene_source(str(path)))
    scene = loaded.scene
    (place,) = [at for at, entry in enumerate(scene.objects) if entry.name == "background_0"]
    row = scene.materials[scene.material_index[scene.object_index == place][0]]
    expected = [0.6 / 1.1, 0.3 / 1.1, 0.0, 0.5 / 1.1, 0.5 / 1.1, 0.5 / 1.1]
    assert row[:6] == pytest.approx(expected, rel=1e-6)  # the rounding of float32
    assert scene.provenance["albedo_scale"] == {"background_0": round(1 / 1.1, 6)}
    lawful = load_source(scene_source(str(tmp_path / "lawful.json")))
    assert "albedo_scale" not in lawful.scene.provenance
    assert lawful.notes == ()
    assert any("diffuse + specular is 1.1000" in note for note in loaded.notes)
    refusing = scene_source(str(path), albedo_over_one="refuse")
    with pytest.raises(TrilightError, match="diffuse \\+ specular is 1.1000; expected at most 1"):
        load_source(refusing)

"""Files of RenderFormer's successor: what can be read of them, and what is said to be lost."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from pipeline.exchange.renderformer_h5 import read_renderformer_h5
from storage.errors import TrilightError
from storage.records.lookup import environment_values
from tests.scenes_by_hand import LIGHT, tiny_scene
from tests.sky_maps import COLOURS, POLES, six_poles


def write_v2(path: Path, lit: bool = True, **more: Any) -> None:
    scene = tiny_scene()
    light = np.zeros((3, 3), np.float16)
    light[2] = 100 if lit else 0
    arrays = {
        "triangles": scene.vertex_positions[scene.faces],
        "vn": scene.vertex_normals[scene.faces],
        "texture": np.random.default_rng(0).random((3, 80, 4, 4)).astype(np.float16),
        "light_strength": light,
        "c2w": scene.c2w,
        "fov": scene.fov_deg,
        **more,
    }
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values


def test_geometry_lights_and_cameras_are_read_and_the_code_is_not(tmp_path: Path) -> None:
    write_v2(tmp_path / "a.h5")
    found = read_renderformer_h5(tmp_path / "a.h5")
    scene, ours = found.scene, tiny_scene()
    assert np.array_equal(scene.vertex_positions[scene.faces], ours.vertex_positions[ours.faces])
    rows = scene.materials[scene.material_index]
    assert rows[0, :7].tolist() == [0.5, 0.5, 0.5, 0, 0, 0, 1]
    assert rows[2, 7:10].tolist() == ours.materials[LIGHT, 7:10].tolist()
    assert scene.environment is None
    (note,) = found.lost
    assert "learned code" in note and "grey of 0.5" in note


@pytest.mark.parametrize("processed", [True, False])
def test_its_environment_has_our_axes(tmp_path: Path, processed: bool) -> None:
    """Raw ones are scaled by their strength; either may be the only light."""
    radiance = six_poles().radiance_rgb
    more: dict[str, Any] = {"env_map": np.moveaxis(radiance, -1, 0) if processed else radiance / 2}
    if not processed:
        more |= {"env_map_strength": np.array(2, np.float32), "env_map_rotation": np.zeros(3, "f4")}
    write_v2(tmp_path / "a.h5", lit=False, **more)
    sky = read_renderformer_h5(tmp_path / "a.h5").scene.environment
    assert sky is not None and not sky.is_seen
    for name, direction in POLES.items():
        assert environment_values(sky, direction) == pytest.approx(COLOURS[name]), name


def test_a_turned_environment_is_said(tmp_path: Path) -> None:
    more: dict[str, Any] = {
        "env_map": six_poles().radiance_rgb,
        "env_map_rotation": np.array([0, 0, 90], "f4"),
    }
    write_v2(tmp_path / "a.h5", **more)
    assert any("rotation of the" in text for text in read_renderformer_h5(tmp_path / "a.h5").lost)


def test_a_map_of_another_shape_is_refused(tmp_path: Path) -> None:
    write_v2(tmp_path / "a.h5", env_map=np.ones((4, 8), np.float32))
    with pytest.raises(TrilightError, match=r"env_map: has shape \[4, 8\]; expected"):
        read_renderformer_h5(tmp_path / "a.h5")

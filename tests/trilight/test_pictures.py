"""Pictures from Python: which cameras are asked for, and what is written of a picture."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.renders.mitsuba_variant import Variant
from storage.errors import TrilightError
from storage.records.exr import decode_exr
from storage.renderer import Camera
from tests.scenes_by_hand import tiny_scene
from trilight import preview_srgb8, render_views, write_picture


def test_every_camera_is_rendered_but_where_some_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Scene:
        """Returns the field of view in place of a picture."""

        def __init__(self, *_: object) -> None: ...

        def render_view(self, camera: Camera) -> tuple[float, int | None]:
            return camera.fov_deg, camera.view

    monkeypatch.setattr("infra.render.path_tracer.SceneInChild", Scene)
    variant = Variant(name="llvm_ad_rgb", libllvm="", note="")  # nothing is traced here
    monkeypatch.setattr("pipeline.renders.mitsuba_variant.choose_variant", lambda default: variant)
    scene = tiny_scene(fov_deg=np.array([45, 50], np.float32))
    first, second = (45, 0), (50, 1)
    found: list[object] = [*render_views(scene)]
    assert found == [first, second]
    assert [*render_views(scene, views=[1, 0])] == [second, first]


def test_a_picture_is_written_as_its_name_says(tmp_path: Path) -> None:
    picture = np.linspace(0, 2, 8 * 8 * 3, dtype=np.float32).reshape(8, 8, 3)
    write_picture(tmp_path / "a.exr", picture)
    back = decode_exr((tmp_path / "a.exr").read_bytes())
    np.testing.assert_array_equal(back, picture.astype(np.float16).astype(np.float32))
    write_picture(tmp_path / "a.PNG", picture)
    shown = np.asarray(Image.open(tmp_path / "a.PNG"))
    np.testing.assert_array_equal(shown, preview_srgb8(picture))
    with pytest.raises(TrilightError, match=r"a\.jpg: .*expected \.exr or \.png"):
        write_picture(tmp_path / "a.jpg", picture)

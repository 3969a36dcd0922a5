"""Pictures from Python: which cameras are asked for, and what is written of a picture."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from storage.errors import TrilightError
from storage.records.exr import decode_exr
from tests.scenes_by_hand import tiny_scene
from trilight import preview_srgb8, render_views, write_picture


def test_every_camera_is_rendered_but_where_some_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Tracer:
        """Returns the field of view in place of a picture."""

        def __init__(self, *_: object, **__: object) -> None: ...
        def open(self, *_: object) -> None: ...
        def close(self) -> None: ...

        def render(self, c2w: object, fov_deg: float, name: str) -> tuple[float, str]:
            return fov_deg, name

    monkeypatch.setattr("pipeline.generation.path_tracer.PathTracer", Tracer)
    monkeypatch.setattr("pipeline.renders.variant.choose_variant", lambda default: None)
    scene = tiny_scene(fov_deg=np.array([45, 50], np.float32))
    first, second = (45, "view 0"), (50, "view 1")
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

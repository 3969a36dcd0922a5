"""Which pictures are taken, and what a user asked for as one complete plan."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from infra.render import plan
from infra.render.networks import NetworkRenderer
from infra.render.options import RenderOptions
from infra.render.path_tracer import PathTracer
from infra.render.plan import plan_render
from infra.render.sources import camera_path, orbit, own_camera, pair_cameras, scene_sources
from pipeline.exchange.open_scene import SceneSource
from pipeline.exchange.reader import SceneReader
from pipeline.isolation import Result
from storage.conventions import look_at_c2w
from storage.dataset.shard import write_shard
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from storage.records.scene_file import encode_scene
from storage.renderer import Camera
from tests.conftest import ROOT
from tests.infra.conftest import write_network
from tests.scenes_by_hand import tiny_sample, tiny_scene


class HereReader(SceneReader):
    """Reads in this process: the tests' own files crash nobody."""

    def _call(self, name: str, function: Callable[..., Result], *args: Any) -> Result:
        return function(*args)


def sources(count: int) -> list[SceneSource]:
    return [SceneSource(path=Path(f"{at}.h5"), key=None) for at in range(count)]


def cameras(count: int) -> list[Camera]:
    return [Camera(c2w=np.eye(4, dtype=np.float32), fov_deg=40.0 + at) for at in range(count)]


def test_a_turn_begins_at_the_camera_and_looks_at_one_point() -> None:
    """And an arc has it in its middle. Float32 positions of about 2 m are exact to 1e-6."""
    scene = tiny_scene()
    start = own_camera(scene, 0)
    turn = orbit(scene, start, 8, 360)
    np.testing.assert_allclose(turn[0].c2w, start.c2w, atol=1e-6)
    eyes = np.array([camera.c2w[:3, 3] for camera in turn])
    np.testing.assert_allclose(eyes[:, 2], start.c2w[2, 3], atol=1e-6)
    np.testing.assert_allclose(np.hypot(eyes[:, 0], eyes[:, 1]), 2, atol=1e-5)
    np.testing.assert_allclose(eyes[2], [0, 2, 1], atol=1e-5)  # a quarter, counter-clockwise
    for camera in turn:
        assert camera.fov_deg == start.fov_deg
        expected = look_at_c2w(eye=camera.c2w[:3, 3], target=[0, 0, 0], up=[0, 0, 1])
        np.testing.assert_allclose(camera.c2w, expected, atol=1e-5)
        scene.with_cameras(camera.c2w[None], np.array([camera.fov_deg], np.float32)).check()
    arc = orbit(scene, start, 3, 180)
    np.testing.assert_allclose(arc[1].c2w, start.c2w, atol=1e-6)
    np.testing.assert_allclose(arc[0].c2w[:3, 3], [0, -2, 1], atol=1e-5)
    np.testing.assert_allclose(arc[2].c2w[:3, 3], [0, 2, 1], atol=1e-5)
    np.testing.assert_allclose(orbit(scene, start, 1, 90)[0].c2w, start.c2w, atol=1e-6)
    away = look_at_c2w(eye=[2, 0, 1], target=[4, 0, 1], up=[0, 0, 1]).astype(np.float32)
    for camera in orbit(scene, Camera(c2w=away, fov_deg=40.0), 4, 360):  # about itself
        np.testing.assert_allclose(camera.c2w[:3, 3], [2, 0, 1], atol=1e-6)


def test_scenes_and_cameras_go_together() -> None:
    first, second = sources(2)
    assert pair_cameras(sources(2), [7]) == [(first, 7), (second, 7)]
    one, three = sources(1), cameras(3)
    assert pair_cameras(one, three) == [(first, camera) for camera in three]
    assert pair_cameras(sources(3), three) == list(zip(sources(3), three, strict=True))
    assert [camera for _, camera in pair_cameras(sources(3), three[:1])] == [three[0]] * 3
    with pytest.raises(TrilightError, match="2 scenes and 3 cameras; expected one of either"):
        pair_cameras(sources(2), three)


def test_a_path_is_a_list_of_cameras_or_any_scene(tmp_path: Path) -> None:
    listed = {"position": [2, 0, 1], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 45}
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"cameras": [listed, {**listed, "fov": 1}]}))
    (tmp_path / "tiny.safetensors").write_bytes(encode_scene(tiny_scene()))
    found = camera_path(str(path), HereReader(), 0)
    assert [camera.fov_deg for camera in found] == [45, 1]
    np.testing.assert_allclose(found[0].c2w, tiny_scene().c2w[0], atol=1e-6)  # rounded to float32
    own = camera_path(str(tmp_path / "tiny.safetensors"), HereReader(), 0)
    np.testing.assert_array_equal([camera.c2w for camera in own], tiny_scene().c2w)
    for broken, message in (
        ({**listed, "look_at": [2, 0, 1]}, r"path.json: cameras\[0\] looks from"),
        ({**listed, "fov": 180}, r"path.json: cameras\[0\].fov is 180"),
    ):
        path.write_text(json.dumps({"cameras": [broken]}))
        with pytest.raises(TrilightError, match=message):
            camera_path(str(path), HereReader(), 0)


def test_numbered_scenes_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (2, 10, 1):
        (tmp_path / f"scene{number}.safetensors").write_bytes(encode_scene(tiny_scene()))
    (tmp_path / "notes.txt").write_text("no scene")
    folder = [source.path.name for source in scene_sources(str(tmp_path), HereReader())]
    assert folder == ["scene1.safetensors", "scene2.safetensors", "scene10.safetensors"]
    braces = scene_sources(f"{tmp_path}/scene{{1..2}}.safetensors", HereReader())
    assert [source.path.name for source in braces] == folder[:2]
    with pytest.raises(TrilightError, match=r"scene3.safetensors: no such file"):
        scene_sources(f"{tmp_path}/scene{{1..3}}.safetensors", HereReader())
    with pytest.raises(TrilightError, match="scenes .*: a brace is not closed"):
        scene_sources(f"{tmp_path}/scene{{1.safetensors", HereReader())
    (tmp_path / "none").mkdir()
    with pytest.raises(TrilightError, match="none: holds no scene file"):
        scene_sources(str(tmp_path / "none"), HereReader())
    keys = ["000000003", "000000007"]
    shard = tmp_path / "train-000000.tar"
    write_shard(shard, [(key, encode_sample(tiny_sample(key=key))) for key in keys])
    assert [source.key for source in scene_sources(str(shard), HereReader())] == keys
    assert [source.key for source in scene_sources(f"{shard}::{keys[1]}", HereReader())] == keys[1:]


def test_a_plan_has_all_that_was_asked(source: Path, tmp_path: Path) -> None:
    """One picture is of the scene's own camera; both engines share the width."""
    one = {"out": tmp_path / "new/x.exr", "view": 1, "threads": 3}
    plan = plan_render(RenderOptions(source=str(source), **one), HereReader())  # type: ignore[arg-type]
    (shot,), (tracer,) = plan.shots, plan.renderers
    assert isinstance(tracer, PathTracer)
    assert (tracer.child.threads, tracer.settings.resolution, plan.resolution) == (3, 512, 512)
    assert (shot.camera, shot.png) == (1, tmp_path / "new/x.png")
    assert shot.exrs == {"mitsuba": tmp_path / "new/x.exr"}
    network = str(write_network(tmp_path / "model.safetensors"))
    asked = RenderOptions(
        source=str(source), out=tmp_path / "turn.webp", engine="both", checkpoint=network,
        resolution=16, orbit=3,
    )  # fmt: skip
    plan = plan_render(asked, HereReader())
    mitsuba, neural = plan.renderers
    assert isinstance(mitsuba, PathTracer) and isinstance(neural, NetworkRenderer)
    assert mitsuba.settings.resolution == neural.resolution == plan.resolution == 16
    assert neural.checkpoint == network
    assert plan.output.video == tmp_path / "turn.webp"
    assert len(plan.shots) == 3
    last, folder = plan.shots[2], tmp_path / "turn"
    assert isinstance(last.camera, Camera)
    assert (last.camera.name, last.camera.view) == ("picture 000002", None)
    assert last.exrs == {name: folder / f"000002.{name}.exr" for name in ("mitsuba", "neural")}
    assert last.png == folder / "000002.png"


def test_the_pictures_of_a_turn_share_the_loading_of_its_scene(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[float] = []

    def price_all(*_: object, per_scene: float, **__: object) -> None:
        told.append(per_scene)
        raise TrilightError("no way to it")

    monkeypatch.setattr(plan, "price_all", price_all)
    for more in ({"out": tmp_path / "x.exr"}, {"out": tmp_path / "turn", "orbit": 3}):
        with pytest.raises(TrilightError, match="no way"):
            plan_render(RenderOptions(source=str(source), seconds=1.0, **more), HereReader())
    assert told == [1, 3]


def test_only_the_plan_reads_what_was_asked() -> None:
    """No other file reads an option of the command, so that a picture depends on the plan alone."""
    readers = {
        path.name
        for path in (ROOT / "infra/render").glob("*.py")
        if re.search(r"\boptions\.\w", path.read_text().replace("render.options", ""))
    }
    assert readers == {"plan.py"}
    assert "options." not in (ROOT / "infra/cli/rendered.py").read_text()

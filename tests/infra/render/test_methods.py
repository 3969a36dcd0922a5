"""What networks are judged beside, which pictures are taken, and the plan of all that was asked."""

import contextlib
import dataclasses
import json
import re
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray

from infra.bench.workloads.traced_pictures import difference_db
from infra.render import plan
from infra.render.networks import (
    DirectLightRenderer,
    NetworkRenderer,
    traced_network,
    untrained_network,
)
from infra.render.path_tracer import MOST_SCENES, PathTracer, RenderChild, RenderWorker
from infra.render.plan import (
    RenderOptions,
    pair_cameras,
    plan_render,
)
from infra.render.raw_references import true_error, true_error_db
from infra.render.run_render import Frame, flicker, orbit
from model.config import SIZES
from model.inference import NeuralRenderer
from pipeline.exchange.reader import SceneReader, SceneSource, scene_source
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.preview import PreviewSettings
from pipeline.renders.settings import measured_settings
from storage.conventions import log10_radiance, look_at_c2w
from storage.dataset.shard import write_shard
from storage.errors import TrilightError, Unrenderable
from storage.metrics import psnr_linear_db, psnr_log_db
from storage.records.sample import encode_sample
from storage.records.scene_file import encode_scene
from storage.renderer import Camera, Image, Renderer, Sampling, fingerprint
from tests.conftest import ROOT
from tests.for_each import case
from tests.infra.conftest import write_network
from tests.scenes_by_hand import tiny_sample, tiny_scene
from tests.train.toy import toy_scene

SCENE = toy_scene(2)
PX = 16


def shown(renderer: Renderer) -> np.ndarray:
    return renderer.load(SCENE, "toy").render(Camera.of_scene(SCENE, 0)).radiance_rgb


def network(opened: NeuralRenderer) -> NetworkRenderer:
    return NetworkRenderer(checkpoint="toy", resolution=PX, opened=opened)


def test_light_of_lamps_is_what_is_left_when_nothing_is_gathered() -> None:
    """And the smallest layers show what large ones show."""
    of_lamps = shown(DirectLightRenderer(resolution=PX))
    config = dataclasses.replace(SIZES["hits-smoke"](), gather_rays=0)
    # the network's picture went through log10(1 + radiance) in float32
    np.testing.assert_allclose(
        of_lamps, shown(network(untrained_network(config))), rtol=1e-4, atol=1e-5
    )
    assert of_lamps.max() > 0.01
    small = shown(network(traced_network()))
    assert small.mean() > of_lamps.mean(), "other surfaces send light too"
    unfiltered = dataclasses.replace(SIZES["hits-smoke"](), filter_width=0)
    large = shown(network(untrained_network(unfiltered)))
    np.testing.assert_allclose(small, large, rtol=1e-3, atol=1e-4)  # sums in another order


def frame(name: str, key: str | None, error: float) -> Frame:
    return Frame(
        source=SceneSource(path=Path(name), key=key),
        error_RR3=np.full((4, 4, 3), error, np.float32),
        noise_floor_db=20.0,
    )


def test_only_frames_of_one_scene_or_stage_flicker() -> None:
    for before, now, goes_on in [
        (("a.safetensors", None), ("a.safetensors", None), True),
        (("stage.usda", "1"), ("stage.usda", "2"), True),
        (("s.tar", "000000001"), ("s.tar", "000000001"), True),
        (("s.tar", "000000001"), ("s.tar", "000000002"), False),
        (("0.h5", None), ("1.h5", None), False),
    ]:
        with case((before, now, goes_on)):
            found = flicker(frame(*before, 0.1), frame(*now, 0.2))
            assert (found is not None) == goes_on
            if found is not None:
                # a change of 0.1 everywhere is 20 dB; two floors of 20 dB are 3 dB worse together
                assert found["db"] == pytest.approx(20, abs=1e-4)
                assert found["noise_db"] == pytest.approx(20 - 10 * np.log10(2))
    first = frame("a.safetensors", None, 0.1)
    assert flicker(None, first) is None
    calm = flicker(first, first)
    assert calm is not None and calm["db"] == 100


HALF_PX = 64
EVERYWHERE = np.ones((HALF_PX, HALF_PX), bool)


def _truth() -> NDArray[np.float64]:
    return np.linspace(0.05, 0.9, HALF_PX * HALF_PX * 3).reshape(HALF_PX, HALF_PX, 3)


def _noisy(rng: np.random.Generator, spread: float) -> NDArray[np.float64]:
    return _truth() + rng.normal(0, spread, (HALF_PX, HALF_PX, 3))


def test_noise_of_the_reference_does_not_count() -> None:
    """Halves with three times the picture's error: 12,288 values leave 0.4 dB open, here thrice."""
    rng = np.random.default_rng(0)
    picture = (_truth() + rng.normal(0, 0.01, (HALF_PX, HALF_PX, 3))).astype(np.float32)
    halves = np.stack([_noisy(rng, 0.03), _noisy(rng, 0.03)])
    for curve, metric in ((log10_radiance, psnr_log_db), (clamped_radiance, psnr_linear_db)):
        exact = metric(picture, _truth().astype(np.float32))
        found, open_db = true_error_db(picture, halves, curve, EVERYWHERE)
        assert found == pytest.approx(exact, abs=1.3)
        assert 0.2 < open_db < 0.8, "and it says how much that is"
        plain = metric(picture, halves.mean(axis=0).astype(np.float32))
        assert plain < exact - 5, "the mean of the halves would have hidden the picture's error"


@pytest.mark.parametrize("noise", [0.002, 0.03])
def test_what_a_reference_leaves_open_is_how_far_its_errors_spread(noise: float) -> None:
    """Of a known picture, where the error is far above the noise and where it is far below.

    The channels of a pixel have one noise, as those of a path do.
    """
    rng = np.random.default_rng(3)
    picture = (_truth() + rng.normal(0, 0.01, (HALF_PX, HALF_PX, 3))).astype(np.float32)
    found, opens = [], []
    for _ in range(200):
        halves = _truth() + rng.normal(0, noise, (2, HALF_PX, HALF_PX, 1))
        error, spread = true_error(picture, halves, clamped_radiance, EVERYWHERE)
        found.append(error)
        opens.append(spread)
    assert np.mean(found) == pytest.approx(1e-4, rel=0.1)
    assert np.sqrt(np.mean(np.square(opens))) == pytest.approx(np.std(found), rel=0.15)


def test_two_renderers_without_noise() -> None:
    rng = np.random.default_rng(1)
    one, other = (
        factor * np.stack([_noisy(rng, 0.05), _noisy(rng, 0.05)]) for factor in (1.0, 1.1)
    )
    apart = log10_radiance(_truth()) - log10_radiance(1.1 * _truth())
    exact = -10 * np.log10(np.square(apart).mean())
    assert difference_db(one, other, log10_radiance) == pytest.approx(exact, abs=0.5)
    same = np.stack([_noisy(rng, 0.05), _noisy(rng, 0.05)])
    assert difference_db(one, same, log10_radiance) > exact + 8


TINY = tiny_scene()
TINY_CAMERA = Camera.of_scene(TINY, 0)
FEW = PreviewSettings(resolution=32, spp=4)
MEASURED = measured_settings(32, {"noise_floor_db": 95.0}, max_spp=1024)


class Enough(Exception):
    """Ends a picture."""


def test_path_tracers_share_a_child_that_can_be_stopped_and_keeps_few_scenes() -> None:
    told = list[Sampling | Image]()
    with contextlib.closing(RenderChild(choose_variant(), threads=1)) as child:
        growing = PathTracer(child, MEASURED, shows_looks=True)
        grown = growing.load(TINY, "tiny")
        with pytest.raises(Enough):
            grown.render(TINY_CAMERA, mock.Mock(side_effect=Enough))
        last = grown.render(TINY_CAMERA, told.append)
        looks = [step for step in told if isinstance(step, Image)]
        assert len(looks) > 3 and any(isinstance(step, Sampling) for step in told)
        assert looks[0].stated_error_db is None and "not measured" in looks[0].remark
        assert last.stated_error_db is not None and (last.samples or 0) > 256
        assert (last.cpu_seconds or 0) > (looks[0].cpu_seconds or 0) > 0
        plain = PathTracer(child, MEASURED).load(TINY, "tiny").render(TINY_CAMERA)
        np.testing.assert_array_equal(last.radiance_rgb, plain.radiance_rgb)
        preview = PathTracer(child, FEW).load(TINY, "tiny")
        assert child._child.call_method(count_loaded) == MOST_SCENES
        picture = preview.render(TINY_CAMERA)
        assert (picture.samples, picture.facts) == (4, {"spp": 4})
        again = grown.render(TINY_CAMERA)  # it was forgotten, and is sent again
        assert psnr_log_db(again.radiance_rgb, last.radiance_rgb) > 90
        dark = tiny_scene(
            faces=TINY.faces[2:],
            material_index=np.array([1], np.uint16),
            object_index=np.array([1], np.uint16),
        )
        with pytest.raises(Unrenderable, match="^dark cannot be rendered .no_surfaces"):
            growing.load(dark, "dark")


def count_loaded(worker: RenderWorker) -> int:
    """Return the number of scenes in a child."""
    return len(worker._loaded)


def test_a_fingerprint_tells_quality_width_and_seed_apart() -> None:
    child = RenderChild(choose_variant(), threads=1)
    tracers = [
        PathTracer(child, FEW),
        PathTracer(child, FEW, seed=1),
        PathTracer(child, PreviewSettings(resolution=64, spp=4)),
        PathTracer(child, MEASURED),
    ]
    assert len({fingerprint(tracer.identity) for tracer in tracers}) == len(tracers)
    assert fingerprint(PathTracer(child, FEW, name="other").identity) == fingerprint(
        tracers[0].identity
    )


def sources(count: int) -> list[SceneSource]:
    return [SceneSource(path=Path(f"{at}.h5"), key=None) for at in range(count)]


def cameras(count: int) -> list[Camera]:
    return [Camera(c2w=np.eye(4, dtype=np.float32), fov_deg=40.0 + at) for at in range(count)]


def test_a_turn_begins_at_the_camera_and_looks_at_one_point() -> None:
    """And an arc has it in its middle. Float32 positions of about 2 m are exact to 1e-6."""
    scene = tiny_scene()
    start = Camera.of_scene(scene, 0)
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
    """Of a file of many scenes, it has one camera of each."""
    listed = {"position": [2, 0, 1], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 45}
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"cameras": [listed, {**listed, "fov": 1}]}))
    (tmp_path / "tiny.safetensors").write_bytes(encode_scene(tiny_scene()))
    reader = SceneReader()
    found = reader.cameras(scene_source(str(path)), 0)
    assert [camera.fov_deg for camera in found] == [45, 1]
    np.testing.assert_allclose(found[0].c2w, tiny_scene().c2w[0], atol=1e-6)  # rounded to float32
    own = reader.cameras(scene_source(str(tmp_path / "tiny.safetensors")), 0)
    np.testing.assert_array_equal([camera.c2w for camera in own], tiny_scene().c2w)
    shard = tmp_path / "train-000000.tar"
    write_shard(shard, [(key, encode_sample(tiny_sample(key=key))) for key in ("0", "1")])
    many = scene_source(str(shard), many=True)
    of_frames = [(camera.c2w, camera.view) for camera in reader.cameras(many, 1)]
    np.testing.assert_array_equal([c2w for c2w, _ in of_frames], [tiny_scene().c2w[1]] * 2)
    assert [view for _, view in of_frames] == [None] * 2
    with pytest.raises(TrilightError, match="--view is 2; expected 0 to 1"):
        reader.cameras(many, 2)
    for broken, message in (
        ({**listed, "look_at": [2, 0, 1]}, r"path.json: cameras\[0\] looks from"),
        ({**listed, "fov": 180}, r"path.json: cameras.0.fov is 180"),
    ):
        path.write_text(json.dumps({"cameras": [broken]}))
        with pytest.raises(TrilightError, match=message):
            reader.cameras(scene_source(str(path)), 0)


def test_numbered_scenes_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (2, 10, 1):
        (tmp_path / f"scene{number}.safetensors").write_bytes(encode_scene(tiny_scene()))
    (tmp_path / "notes.txt").write_text("no scene")
    folder = [source.path.name for source in SceneReader().list_scenes(str(tmp_path))]
    assert folder == ["scene1.safetensors", "scene2.safetensors", "scene10.safetensors"]
    braces = SceneReader().list_scenes(f"{tmp_path}/scene{{1..2}}.safetensors")
    assert [source.path.name for source in braces] == folder[:2]
    with pytest.raises(TrilightError, match=r"scene3.safetensors: no such file"):
        SceneReader().list_scenes(f"{tmp_path}/scene{{1..3}}.safetensors")
    with pytest.raises(TrilightError, match="scenes .*: a brace is not closed"):
        SceneReader().list_scenes(f"{tmp_path}/scene{{1.safetensors")
    (tmp_path / "none").mkdir()
    with pytest.raises(TrilightError, match="none: holds no scene file"):
        SceneReader().list_scenes(str(tmp_path / "none"))
    keys = ["000000003", "000000007"]
    shard = tmp_path / "train-000000.tar"
    write_shard(shard, [(key, encode_sample(tiny_sample(key=key))) for key in keys])
    assert [source.key for source in SceneReader().list_scenes(str(shard))] == keys
    assert [source.key for source in SceneReader().list_scenes(f"{shard}::{keys[1]}")] == keys[1:]


def test_a_plan_has_all_that_was_asked(source: Path, tmp_path: Path) -> None:
    """One picture is of the scene's own camera; both engines share the width."""
    one = {"out": tmp_path / "new/x.exr", "view": 1, "threads": 3}
    plan = plan_render(RenderOptions(source=str(source), **one), SceneReader())  # type: ignore[arg-type]
    ((_, camera),), (tracer,) = plan.pairs, plan.renderers
    assert isinstance(tracer, PathTracer)
    assert (tracer.child.threads, tracer.settings.resolution, plan.resolution) == (3, 512, 512)
    assert (camera, plan.view, plan.output.stem_of(0)) == (0, 1, tmp_path / "new/x")
    network = str(write_network(tmp_path / "model.safetensors"))
    asked = RenderOptions(
        source=str(source), out=tmp_path / "turn.webp", engine="both", checkpoint=network,
        resolution=16, orbit=3,
    )  # fmt: skip
    plan = plan_render(asked, SceneReader())
    mitsuba, neural = plan.renderers
    assert isinstance(mitsuba, PathTracer) and isinstance(neural, NetworkRenderer)
    assert mitsuba.settings.resolution == neural.resolution == plan.resolution == 16
    assert neural.checkpoint == network
    assert plan.output.video == tmp_path / "turn.webp"
    assert [camera for _, camera in plan.pairs] == [0, 1, 2] and plan.orbit == (3, 360)
    assert plan.output.stem_of(2) == tmp_path / "turn/000002"


def test_nothing_is_read_before_a_mistake_that_needs_no_file_is_named(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A film of many scenes, or a path of cameras, may take minutes to read."""
    (tmp_path / "file").touch()
    monkeypatch.setitem(sys.modules, "av", None)
    reader = mock.Mock(spec=SceneReader)
    for more, message in (
        ({"out": tmp_path / "x.mp4"}, "needs PyAV, which is not installed: pip install av"),
        ({"out": tmp_path / "file/x.webp"}, "file is a file; expected a folder"),
        ({"out": tmp_path / "file/x.exr"}, "file is a file; expected a folder"),
        ({"out": tmp_path / "new", "max_spp": 100}, "max_spp 100; expected multiples of 8"),
    ):
        with pytest.raises(TrilightError, match=message):
            plan_render(RenderOptions(source=str(source), **more), reader)
    monkeypatch.setenv("TRILIGHT_VARIANT", "none such")
    path = {"out": tmp_path / "new/turn.webp", "cameras": str(source)}
    with pytest.raises(TrilightError, match="TRILIGHT_VARIANT is 'none such'"):
        plan_render(RenderOptions(source=str(source), **path), reader)  # type: ignore[arg-type]
    assert {name for name, _, _ in reader.method_calls} == {"list_scenes"}
    assert not (tmp_path / "new").exists()


def test_the_pictures_of_a_turn_share_the_loading_of_its_scene(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    price_all = mock.Mock(side_effect=TrilightError("no way to it"))
    monkeypatch.setattr(plan, "price_all", price_all)
    for more in ({"out": tmp_path / "x.exr"}, {"out": tmp_path / "turn", "orbit": 3}):
        with pytest.raises(TrilightError, match="no way"):
            plan_render(RenderOptions(source=str(source), seconds=1.0, **more), SceneReader())
    assert [each.kwargs["per_scene"] for each in price_all.call_args_list] == [1, 3]


def test_only_the_plan_reads_what_was_asked() -> None:
    """No other file reads an option of the command, so that a picture depends on the plan alone."""
    readers = {
        path.name
        for path in (ROOT / "infra/render").glob("*.py")
        if re.search(r"\boptions\.\w", path.read_text())
    }
    assert readers == {"plan.py"}
    printing = (ROOT / "infra/cli/render.py").read_text().partition("def print_outcome(")[2]
    assert printing and "options." not in printing

"""Files of many pictures: numbered, kept where they would come out again, shown in a row."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Picture

from infra.render.networks import RendererHere, SceneHere
from infra.render.plan import (
    OutputPaths,
    Pairs,
    RenderPlan,
    output_paths,
    pair_cameras,
)
from infra.render.run_render import FinishedShot, orbit, run_plan, write_video
from infra.render.tone_mapping import ToneMap, load_filmic, tone_mapped
from pipeline.exchange.reader import SceneReader, SceneSource
from storage.conventions import preview_srgb8
from storage.errors import TrilightError
from storage.records.exr import decode_exr
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene
from storage.renderer import Camera, Image, ReadyScene
from tests.scenes_by_hand import tiny_scene


class FlatRenderer(RendererHere):
    """Every picture is as bright as the camera stands far to the right; counts its work."""

    resolution = 16

    def __init__(self, name: str = "neural", setting: int = 0) -> None:
        self.name = name
        self.setting = setting
        self.opened = 0
        self.rendered = 0
        self.asked: list[str] = []

    @property
    def identity(self) -> Mapping[str, Any]:
        return {"setting": self.setting}

    def load(self, scene: Scene, name: str) -> ReadyScene:
        self.opened += 1
        return SceneHere(render_image=self.render, notes=("it was opened",))

    def render(self, camera: Camera) -> Image:
        self.rendered += 1
        self.asked.append(camera.name)
        picture = np.full((16, 16, 3), 3 + camera.c2w[0, 3], np.float32)
        facts = {"number": self.rendered, "half": 0.5}
        return Image(radiance_rgb=picture, cpu_seconds=0.0, facts=facts)


@pytest.fixture
def turn(source: Path) -> Pairs:
    cameras = orbit(tiny_scene(), Camera.of_scene(tiny_scene(), 0), 4, 360)
    return pair_cameras([SceneSource(path=source, key=None)], cameras)


def run(
    renderers: list[FlatRenderer],
    out: Path,
    pairs: Pairs,
    tone_map: ToneMap = "plain",
    exposure_ev: float = 0.0,
) -> tuple[Sequence[FinishedShot], Sequence[str]]:
    plan = RenderPlan(
        source="tiny",
        view=0,
        renderers=renderers,
        resolution=16,
        tone_map=tone_map,
        exposure_ev=exposure_ev,
        output=output_paths(out),
        pairs=pairs,
        fps=24,
    )
    return run_plan(plan, SceneReader(), lambda done, total: None, lambda now: None)


def test_pictures_are_numbered_and_what_is_there_is_kept(turn: Pairs, tmp_path: Path) -> None:
    """The scene is opened once, and only the rest is made."""
    out = tmp_path / "turn"
    engine, again, nothing = FlatRenderer(), FlatRenderer(), FlatRenderer()
    first, notes = run([engine], out, turn)
    assert (engine.opened, engine.rendered) == (1, 4)
    assert engine.asked == [f"picture {at:06d}" for at in range(4)]
    assert notes == ["tiny.safetensors: it was opened"]
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert sorted(before) == [f"{at:06d}.{suffix}" for at in range(4) for suffix in ("exr", "png")]
    for shot, value in zip(first, [5, 3, 1, 3], strict=True):
        np.testing.assert_allclose(decode_exr(shot.pictures["neural"].path.read_bytes()), value)
    (out / "000002.exr").unlink()
    (out / "000003.exr").write_bytes(before["000003.exr"][:200])
    second, _ = run([again], out, turn)
    assert (again.opened, again.rendered) == (1, 2)
    kept = [shot.pictures["neural"] for shot in second]
    assert [picture.seconds is None for picture in kept] == [True, True, False, False]
    assert kept[1].facts == first[1].pictures["neural"].facts == {"number": 2, "half": 0.5}
    for shown in ("000000.png", "000003.png"):
        assert (out / shown).read_bytes() == before[shown]
    run([nothing], out, turn)
    assert (nothing.opened, nothing.rendered) == (0, 0)


def test_pictures_of_other_settings_scenes_or_cameras_are_made_anew(
    turn: Pairs, tmp_path: Path
) -> None:
    out = tmp_path / "turn"
    run([FlatRenderer()], out, turn)
    other_setting, other_name = FlatRenderer(setting=1), FlatRenderer(name="mitsuba", setting=1)
    run([other_setting], out, turn)
    run([other_name], out, turn)
    assert (other_setting.rendered, other_name.rendered) == (4, 4)
    moved = FlatRenderer(name="mitsuba", setting=1)
    run([moved], out, turn[1:])
    assert moved.rendered == 3
    changed = FlatRenderer(name="mitsuba", setting=1)
    materials = tiny_scene().materials * np.float32(0.5)
    turn[0][0].path.write_bytes(encode_scene(tiny_scene(materials=materials)))
    run([changed], out, turn)
    assert changed.rendered == 4
    one = FlatRenderer()
    for _ in range(2):
        run([one], tmp_path / "one.exr", [(turn[0][0], 0)])
    assert one.rendered == 2, "a single picture is always made anew"


def test_another_look_needs_no_other_picture(turn: Pairs, tmp_path: Path) -> None:
    """Stops multiply the light by powers of two; the EXR that is measured knows nothing of it."""
    out, again = tmp_path / "turn", FlatRenderer()
    run([FlatRenderer()], out, turn)
    measured = (out / "000000.exr").read_bytes()
    run([again], out, turn, exposure_ev=-3.0)
    assert (out / "000000.exr").read_bytes() == measured
    darker = np.asarray(Picture.open(out / "000000.png"))
    np.testing.assert_array_equal(darker[::16, ::16], preview_srgb8(decode_exr(measured) / 8))
    assert 0 < darker.min() < 255
    pytest.importorskip("PyOpenColorIO", reason="the film-like curve is OpenColorIO's")
    run([again], out, turn, tone_map="filmic")
    assert again.rendered == 0
    assert (np.asarray(Picture.open(out / "000000.png")) != darker).any()


def test_the_film_like_curve_keeps_what_the_plain_one_clips() -> None:
    pytest.importorskip("PyOpenColorIO", reason="the film-like curve is OpenColorIO's")
    levels = np.repeat(np.array([0, 0.01, 0.18, 1, 5, 50, 65504], np.float32)[:, None], 3, axis=1)
    shown = tone_mapped(levels[None], "filmic")[0].astype(int)
    assert (np.diff(shown[:, 0]) > 0).all()
    # ACES 2.0 shows 0.18 as 10 of 100 nits, which sRGB encodes as 89; grey stays grey to a step
    assert abs(shown[2] - 89).max() <= 1
    assert np.ptp(shown, axis=1).max() <= 1
    assert len(np.unique(preview_srgb8(levels)[3:, 0])) == 1


def _frames(folder: Path) -> list[Path]:
    paths = []
    for at in range(6):
        pixels = np.zeros((32, 48, 3), np.uint8)
        pixels[:, 8 * at : 8 * at + 8] = [200, 120, 40]
        paths.append(folder / f"{at}.png")
        Picture.fromarray(pixels).save(paths[-1])
    return paths


def test_a_webp_shows_the_pictures_in_a_row(tmp_path: Path) -> None:
    frames = _frames(tmp_path)
    write_video(tmp_path / "x.webp", frames, 20)
    with Picture.open(tmp_path / "x.webp") as video:
        assert (getattr(video, "n_frames", 1), video.size) == (6, (48, 32))
        for at, path in enumerate(frames):
            video.seek(at)
            shown = np.asarray(video.convert("RGB")).astype(int)
            assert video.info["duration"] == 50
            # lossy: colour has half the resolution, so edges are off, and flat parts by some steps
            assert abs(shown - np.asarray(Picture.open(path))).mean() < 8


def test_an_mp4_shows_the_pictures_in_a_row(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="H.264 is made by PyAV")
    frames = _frames(tmp_path)
    write_video(tmp_path / "x.mp4", frames, 20)
    with av.open(str(tmp_path / "x.mp4")) as video:
        assert (video.streams.video[0].average_rate, video.streams.video[0].frames) == (20, 6)
        shown = [
            frame.reformat(format="rgb24", src_colorspace=1, dst_colorspace=1).to_ndarray()
            for frame in video.decode(video=0)
        ]
    for pixels, path in zip(shown, frames, strict=True):
        assert abs(pixels.astype(int) - np.asarray(Picture.open(path))).mean() < 8  # as above


def test_out_says_what_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = output_paths(tmp_path / "new/one.exr")
    assert (one.stem_of(7), one.is_sequence) == (tmp_path / "new/one", False)
    many = output_paths(tmp_path / "turn")
    assert many == OutputPaths(out=tmp_path / "turn", folder=tmp_path / "turn")
    assert many.stem_of(7) == tmp_path / "turn/000007"
    shown = output_paths(tmp_path / "turn.webp")
    assert (shown.folder, shown.video) == (tmp_path / "turn", tmp_path / "turn.webp")
    dotted = tmp_path / "run.2"
    dotted.mkdir()
    assert output_paths(dotted).folder == dotted
    with pytest.raises(TrilightError, match=r"--out is .*x.gif; expected picture.exr"):
        output_paths(tmp_path / "x.gif")
    monkeypatch.chdir(tmp_path)
    here = output_paths(Path("."))
    assert (here.folder, here.video, here.is_sequence) == (Path("."), None, True)
    monkeypatch.setitem(__import__("sys").modules, "PyOpenColorIO", None)
    load_filmic.cache_clear()
    with pytest.raises(TrilightError, match="OpenColorIO is not installed"):
        load_filmic()

"""What a user asked for becomes one complete plan; what is below reads the plan alone."""

import re
from pathlib import Path

import pytest

from infra.rendering import plan
from infra.rendering.cameras import ShotCamera
from infra.rendering.engines import MitsubaPlan, NeuralPlan
from infra.rendering.plan import plan_render
from infra.rendering.request import Asked
from storage.errors import TrilightError
from storage.records.scene_file import encode_scene
from tests.conftest import ROOT
from tests.infra.rendering.render_kit import write_network
from tests.infra.rendering.test_cameras import HereReader
from tests.scenes_by_hand import tiny_scene


@pytest.fixture
def scene(tmp_path: Path) -> str:
    path = tmp_path / "tiny.safetensors"
    path.write_bytes(encode_scene(tiny_scene()))
    return str(path)


def test_one_picture_is_of_the_scenes_own_camera(scene: str, tmp_path: Path) -> None:
    asked = Asked(source=scene, out=tmp_path / "new/x.exr", view=1, threads=3)
    plan = plan_render(asked, HereReader())
    (shot,), (engine,) = plan.shots, plan.engines
    assert isinstance(engine, MitsubaPlan)
    assert (engine.threads, engine.settings.resolution, plan.resolution) == (3, 512, 512)
    assert (shot.camera, shot.name) == (1, "tiny.safetensors, view 1")
    assert shot.exrs == {"mitsuba": tmp_path / "new/x.exr"}
    assert shot.png == tmp_path / "new/x.png"


def test_both_engines_share_the_width_and_have_files_of_their_own(
    scene: str, tmp_path: Path
) -> None:
    network = str(write_network(tmp_path / "model.safetensors"))
    asked = Asked(
        source=scene,
        out=tmp_path / "turn.webp",
        engine="both",
        checkpoint=network,
        resolution=16,
        orbit=3,
    )
    plan = plan_render(asked, HereReader())
    mitsuba, neural = plan.engines
    assert isinstance(mitsuba, MitsubaPlan) and isinstance(neural, NeuralPlan)
    assert mitsuba.settings.resolution == neural.resolution == plan.resolution == 16
    assert neural.checkpoint == network
    assert plan.place.video == tmp_path / "turn.webp"
    assert len(plan.shots) == 3
    assert all(isinstance(shot.camera, ShotCamera) for shot in plan.shots)
    last, folder = plan.shots[2], tmp_path / "turn"
    assert last.name == "tiny.safetensors, picture 000002"
    assert last.exrs == {name: folder / f"000002.{name}.exr" for name in ("mitsuba", "neural")}
    assert last.png == folder / "000002.png"


def test_the_pictures_of_a_turn_share_the_loading_of_its_scene(
    scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[float] = []

    def priced_ways(*_: object, per_scene: float, **__: object) -> None:
        told.append(per_scene)
        raise TrilightError("no way to it")

    monkeypatch.setattr(plan, "priced_ways", priced_ways)
    for more in ({"out": tmp_path / "x.exr"}, {"out": tmp_path / "turn", "orbit": 3}):
        with pytest.raises(TrilightError, match="no way"):
            plan_render(Asked(source=scene, seconds=1.0, **more), HereReader())
    assert told == [1, 3]


def test_what_cannot_be_done_is_said_before_anything_is_made(scene: str, tmp_path: Path) -> None:
    for more, message in (
        ({"orbit": 3}, "expected a folder, X.mp4 or X.webp for many"),
        ({"resolution": 20}, "expected a multiple of 8"),
        ({"engine": "neural", "checkpoint": "none.safetensors"}, "no such file or folder"),
    ):
        with pytest.raises(TrilightError, match=message):
            plan_render(Asked(source=scene, out=tmp_path / "x.exr", **more), HereReader())
    assert not (tmp_path / "x.exr").exists()


def test_only_the_plan_reads_what_was_asked() -> None:
    """No other file reads an option of the command, so that a picture depends on the plan alone."""
    readers = {
        path.name
        for path in (ROOT / "infra/rendering").glob("*.py")
        if re.search(r"\basked\.\w", path.read_text().replace("rendering.asked", ""))
    }
    assert readers == {"plan.py", "run.py"}, "run.py opens the reader of scenes"
    assert "asked" not in (ROOT / "infra/cli/rendered.py").read_text()

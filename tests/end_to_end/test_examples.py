"""Each file of examples/, copied to another folder and used from there as its first lines say."""

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from infra.cli.extend_option import load_extensions
from model.config import SIZES, ModelConfig
from pipeline.exchange.convert import write_scene
from pipeline.exchange.reader import load_source, scene_source
from pipeline.executors.registry import EXECUTORS
from pipeline.objects.sources import check_source, list_objects
from pipeline.presets.registry import DATASET_PRESETS, preset_settings, resolve_dataset_preset
from scene_templates.scene_maps import draw_look
from scene_templates.skies.procedural_skies import draw_sky
from storage.dataset.manifest import read_manifest
from storage.errors import TrilightError
from storage.records.scene_file import decode_scene_file, encode_scene
from storage.seeds import rng_for
from storage.settings.overrides import apply_overrides
from tests.end_to_end.conftest import Trilight
from tests.end_to_end.production_kit import FEW_SAMPLES
from tests.extensions_kit import EXAMPLES, loaded, room_for_extensions
from tests.for_each import for_each
from tests.scene_templates.balls import one_drawn
from tests.scene_templates.statistics import with_draws
from tests.scenes_by_hand import tiny_scene
from train.evaluation.metrics import METRICS, picture_scores
from train.presets import override_training_preset, resolve_training_preset

FILES = sorted(path.name for path in EXAMPLES.glob("*.py"))


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[str], Path]:
    def copy(name: str) -> Path:
        return Path(shutil.copy(EXAMPLES / name, tmp_path))

    return copy


@for_each("name", FILES)
def test_an_example_is_short_and_shows_its_command(name: str) -> None:
    text = (EXAMPLES / name).read_text()
    assert 20 <= len(text.splitlines()) <= 60
    shown = re.findall(r"^    trilight .*$", text, re.MULTILINE)
    assert shown
    assert all(f" {name}" in line for line in shown)


def test_a_template_and_a_family_make_scenes(copied: Callable[[str], Path]) -> None:
    with loaded(copied("template.py")):
        settings = preset_settings("smoke", changes={"scenes.families": "corridor"}).scenes
        layouts = [one_drawn(settings, index).layout for index in range(8)]
    assert {tuple(part.name for part in layout.shell) for layout in layouts} == {
        ("floor", "wall1", "wall2")
    }
    with loaded(copied("family.py")):
        settings = preset_settings("smoke", changes={"scenes.families": "crowd"}).scenes
        assert 5 <= len(one_drawn(settings, 0).layout.objects) <= 8


def test_a_surface_repeats_and_lies_in_scenes(copied: Callable[[str], Path]) -> None:
    with loaded(copied("surface.py")):
        changes = {"scenes.textures.surfaces.families": ["polka_dots"], "scenes.textures.share": 1}
        settings = preset_settings("smoke", changes=changes).scenes.textures
        look = draw_look(rng_for(0, "look"), settings)
    assert look is not None and look.maps.source.name == "polka_dots"
    diffuse = look.maps.diffuse_rgb
    # dots in rows: half of the texels of a spacing are on the ground at least, and both paints show
    assert 2 <= len(np.unique(diffuse.reshape(-1, 3), axis=0)) < diffuse[..., 0].size / 2
    np.testing.assert_allclose(diffuse.mean(axis=0), diffuse.mean(axis=1), atol=1e-6)  # symmetric


def test_a_sky_is_drawn(copied: Callable[[str], Path]) -> None:
    with loaded(copied("sky.py")):
        changes = {"scenes.skies.maps.families": ["ring"], "scenes.skies.maps.height": 16}
        settings = preset_settings("smoke", changes=changes).scenes.skies.maps
        (family, radiance_rgb), draws = with_draws(draw_sky, rng_for(0, "sky"), settings)
    assert family == "ring" and "height of the ring" in "".join(draws)
    rows = radiance_rgb.mean(axis=(1, 2))
    assert np.unravel_index(rows.argmax(), rows.shape)[0] <= 8 and rows.min() > 0


def test_a_material_column_is_drawn_and_stored(copied: Callable[[str], Path]) -> None:
    with loaded(copied("material_column.py")):
        scene = tiny_scene()
        assert scene.materials.shape[1] == 11
        scene.materials[:, 10] = 0.5
        stored = encode_scene(scene)
        assert (decode_scene_file(stored, "scene").materials[:, 10] == 0.5).all()
        assert SIZES["coated"]().material_columns[-1] == "coat"
    with pytest.raises(TrilightError, match="'coat' is not declared here"):
        decode_scene_file(stored, "scene")


def test_a_dataset_preset_and_a_training_preset_of_a_file(copied: Callable[[str], Path]) -> None:
    with room_for_extensions():
        build = resolve_dataset_preset(f"{copied('dataset_preset.py')}:sunsets")
        settings = preset_settings(build, seed=3)
        assert (settings.build, settings.seed) == ("sunsets", 3)
        assert DATASET_PRESETS[build].num_scenes == 32
        assert settings.scenes.lights.count == (1, 2)
        run = resolve_training_preset(f"{copied('training_preset.py')}:quick_lights")
        assert override_training_preset(run, {"seed": 4}, steps=60).warmup_steps == 10


def test_a_source_lists_objects(
    copied: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And writes nothing into the folder that a person works in."""
    asked: dict[str, Any] = {"allowed_licences": ("CC0-1.0",)}
    with loaded(copied("object_source.py")):
        found = list_objects("dice:3", work_dir=tmp_path, **asked).fetch_selected()
        assert [Path(record.path).is_file() for record in found.records] == [True] * 3
        with pytest.raises(TrilightError, match=r"dice:x'; expected dice:N with N from 1"):
            list_objects("dice:x", work_dir=tmp_path, **asked)
        with pytest.raises(TrilightError, match="dice: states the licence of every object"):
            check_source("dice:3", licence="MIT", **asked)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
        before = set(tmp_path.rglob("*.ply"))
        check_source("dice:3", licence=None, **asked)
        assert {path.parts[-4] for path in set(tmp_path.rglob("*.ply")) - before} == {"cache"}
    with pytest.raises(TrilightError, match="'dice:3' does not exist"):
        check_source("dice:3", licence=None, **asked)


def test_a_metric_joins_the_others(copied: Callable[[str], Path]) -> None:
    target = np.full((32, 32, 3), 2.0)
    with loaded(copied("metric.py")):
        scores = picture_scores(target * 1.5, target, np.ones((32, 32), np.bool_), None)
        assert scores["relative_mse"] == pytest.approx(1 / 4.01)
        assert list(scores)[-1] == "relative_mse"
    assert "relative_mse" not in METRICS


def test_a_format_carries_a_scene_and_says_what_it_lost(
    copied: Callable[[str], Path], tmp_path: Path
) -> None:
    scene, path = tiny_scene(), tmp_path / "a.npz"
    with loaded(copied("scene_format.py")):
        (lost,) = write_scene(path, scene)
        assert "objects.name" in lost
        assert "materials" not in lost
        back = load_source(scene_source(str(path))).scene
        np.testing.assert_array_equal(back.materials, scene.materials)
        np.testing.assert_array_equal(back.triangle_emits, scene.triangle_emits)
        broken = dataclasses.replace(scene, faces=scene.faces + 10_000)
        write_scene(path, broken)
        with pytest.raises(TrilightError, match="faces"):  # by Trilight, not by the file
            load_source(scene_source(str(path)))
    with pytest.raises(TrilightError, match="cannot be read as a scene; expected a scene"):
        scene_source(str(path))


def test_a_size_is_a_setting(copied: Callable[[str], Path]) -> None:
    with loaded(copied("model_size.py")):
        run = override_training_preset("smoke", {"model": "nano", "model.num_registers": 3})
        assert (run.model.width, run.model.num_registers) == (72, 3)
        assert SIZES["nano"]() == apply_overrides(run, {"model.num_registers": 2}).model
    assert "nano" not in ModelConfig.PRESETS


def test_an_executor_is_a_runner(copied: Callable[[str], Path]) -> None:
    path = copied("executor.py")
    with room_for_extensions():
        words = load_extensions(["generate", "smoke", f"--extend={path}", "--runner", "commands"])
        assert words == ["generate", "smoke", "--runner", "commands"]
        assert "commands" in EXECUTORS
        again = load_extensions(["--extend", str(path), "doctor", "--", "--extend"])
        assert again == ["doctor", "--", "--extend"]
        for nothing in (["--extend"], ["--extend="]):
            with pytest.raises(TrilightError, match=r"--extend: names no file; expected"):
                load_extensions(nothing)


TINY = ("--resolution", "32", "--scenes", "4", *FEW_SAMPLES)


@pytest.mark.slow("commands")
@pytest.mark.timeout(1800)
def test_data_of_one_s_own_files_by_the_real_command(
    copied: Callable[[str], Path], trilight: Trilight, tmp_path: Path
) -> None:
    """Executor, source, template, family: the same bytes by another executor; then the checks.

    Two shards, both for training: the executor starts a process for each.
    """
    for name in FILES:
        copied(name)
    own = ("--extend", "template.py", "--extend", "object_source.py")
    drawn = ("--set", 'scenes.families=["corridor", "plane-single"]', "--objects", "dice:40")
    asked = ("generate", "smoke", *own, *TINY, *drawn, "--set", "splits.scenes_per_shard=2")
    trilight(*asked, "--extend", "executor.py", "--runner", "commands", "--out", "a")
    trilight(*asked, "--out", "b")
    digests = [read_manifest(tmp_path / out / "manifest.json").dataset_digest for out in "ab"]
    assert digests[0] == digests[1]
    assert set(read_manifest(tmp_path / "a" / "manifest.json").extensions) == {own[1], own[3]}
    for command in (("verify", "a"), ("inspect", "a"), ("status", "a")):  # without the files
        trilight(*command)
    assert "corridor" in (tmp_path / "a" / "README.md").read_text()
    (tmp_path / "a" / "train-000001.tar").write_bytes(b"")
    refused = trilight("verify", "a", "--repair", "--objects", "dice:40", status=1)
    assert "add --extend object_source.py" in refused.stderr
    trilight("verify", "a", "--repair", "--objects", "dice:40", *own)
    trilight(
        "train", "smoke", "--data", "a", "--out", "r", "--steps", "3",
        "--set", "resolution=32", "--set", "views_per_scene=1",
        "--extend", "model_size.py", "--set", "model=nano",
    )  # fmt: skip
    record = json.loads((tmp_path / "r" / "settings.json").read_text())
    assert list(record["extensions"]) == ["model_size.py"]
    data = ("--data", "a", "--split", "train")
    trilight("evaluate", "r", *data, "--extend", "metric.py", "--out", "j")
    assert "relative_mse" in (tmp_path / "j" / "evaluation.md").read_text()


@pytest.mark.slow("commands")
@pytest.mark.timeout(900)
def test_a_run_of_one_s_own_file_by_the_real_command(
    copied: Callable[[str], Path], trilight: Trilight, tmp_path: Path
) -> None:
    path, build = copied("training_preset.py"), copied("dataset_preset.py")
    trilight("generate", f"{build.name}:sunsets", *TINY, "--out", "d")
    quick = ("--set", "resolution=32", "--set", "views_per_scene=1", "--data", "d", "--out", "r")
    train = ("train", f"{path.name}:quick_lights", "--steps", "4", *quick)
    trilight(*train)
    trilight(*train, "--resume")
    with path.open("a") as file:
        file.write("# changed\n")
    refused = trilight(*train, "--resume", status=1)
    assert "was begun with another extension training_preset.py" in refused.stderr
    trilight("model", "r")  # the network itself asks for no file

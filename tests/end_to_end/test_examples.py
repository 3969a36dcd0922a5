"""Each file of examples/, copied to another folder and used from there as its first lines say.

A material column that is declared outside of the product goes through all of it.
"""

import contextlib
import dataclasses
import itertools
import json
import re
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from infra.cli.extend_option import load_extensions
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.quality import FixedSamples
from model.config import SIZES, ModelConfig
from model.inference import NeuralRenderer
from model.open import open_network, save_published
from model.scene_tensors import SceneTensors, batch_scenes, scene_tensors
from pipeline.exchange.convert import write_scene
from pipeline.exchange.open_scene import load_source, scene_source
from pipeline.executors.registry import EXECUTORS
from pipeline.generation.inspect_scene import _facts
from pipeline.objects.sources import check_source, list_objects
from pipeline.presets.registry import DATASET_PRESETS, preset_settings, resolve_dataset_preset
from pipeline.renders.mitsuba_variant import choose_variant
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.settings import SceneSettings
from scene_templates.skies.procedural_skies import draw_sky
from scene_templates.textures import draw_look
from storage.dataset.dataset import Dataset
from storage.dataset.manifest import read_manifest
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from storage.records.material import EMISSION, PUBLISHED_COLUMNS
from storage.records.scene import Scene
from storage.records.scene_file import decode_scene_file, encode_scene
from storage.seeds import rng_for
from storage.settings.overrides import apply_overrides
from tests.columns_kit import COAT, TINT, WITH_COAT, declared
from tests.end_to_end.conftest import Trilight
from tests.end_to_end.production_kit import FEW_SAMPLES
from tests.extensions_kit import EXAMPLES, loaded, room_for_extensions
from tests.for_each import for_each
from tests.infra.child_here import use_children_here
from tests.model.kit import awake, tiny_config
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.scene_templates.balls import one_drawn
from tests.scene_templates.statistics import with_draws
from tests.scenes_by_hand import FLOOR, tiny_scene
from tests.train.kit import TINY_MODEL, tiny_run, trained
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.augment import permute_channels, scale_light
from train.data.bad_samples import BadSampleCounter
from train.data.loader import load_batches
from train.data.order import RankSlice
from train.data.scenes import training_scene
from train.evaluation.metrics import METRICS, picture_scores
from train.loop.train_state import new_state
from train.presets import override_training_preset, resolve_training_preset
from train.settings import TrainSettings

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
    assert look is not None and look.maps.family == "polka_dots"
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
        assert (settings.build, settings.seed, DATASET_PRESETS[build].num_scenes) == (
            "sunsets",
            3,
            32,
        )
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


SETTINGS = SceneSettings(families=DEFAULT_FAMILIES, num_views=2, max_triangles=600)

FOUR = tiny_run(num_steps=4, shuffle_shards=1)


def coated_run() -> TrainSettings:
    return dataclasses.replace(
        FOUR, model=dataclasses.replace(TINY_MODEL, material_columns=WITH_COAT)
    )


def composed(index: int) -> Scene:
    return first_scene(SETTINGS, small_pool(), seed=0, scene_index=index)


@pytest.fixture(scope="module", autouse=True)
def coat() -> Iterator[None]:
    with declared(COAT):
        yield


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("coated")
    return write_toy_dataset(
        folder, train=4, validation=1, per_shard=2, resolution=16, scene_of=composed
    )


@pytest.fixture(scope="module")
def run(data: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "coated"
    trained(coated_run(), [str(data.folder.root)], out)
    return out


def coats(tensors: SceneTensors) -> NDArray[np.float32]:
    assert tensors.columns == WITH_COAT
    return np.asarray(tensors.material_TM[:, -1].numpy())


def test_composed_scenes_differ_in_the_column_alone() -> None:
    scene = composed(0)
    reflects = (scene.materials[:, EMISSION] == 0).all(axis=1)
    drawn = scene.materials[:, -1]
    assert len(np.unique(drawn[reflects])) == reflects.sum() > 1
    assert ((drawn[reflects] >= 0.1) & (drawn[reflects] <= 0.9)).all()
    assert (drawn[~reflects] == 0).all()
    with declared(dataclasses.replace(COAT, draw=None)):
        plain = composed(0)
    assert (plain.materials[:, -1] == 0).all()
    assert np.array_equal(plain.materials[:, :-1], scene.materials[:, :-1])
    assert np.array_equal(plain.vertex_positions, scene.vertex_positions)
    assert np.array_equal(plain.c2w, scene.c2w)


@for_each("number", [2.0, float("nan")])
def test_a_draw_outside_of_the_range_is_named(number: float) -> None:
    wrong = dataclasses.replace(COAT, draw=lambda rng, count: np.full((count, 1), number))
    with declared(wrong), pytest.raises(TrilightError, match="'coat': its draw returned"):
        composed(0)


def test_the_stream_shows_what_was_composed(data: Dataset) -> None:
    settings = dataclasses.replace(coated_run(), scenes_per_step=4)
    batches = load_batches(
        open_training_data([str(data.folder.root)]).split("train"),
        settings,
        0,
        rank_slice=RankSlice(rank=0, world_size=1),
        workers=1,
        unusable=BadSampleCounter(0),
    )
    with contextlib.closing(batches):
        (batch,) = itertools.islice(batches, 1)
    assert {scene.key for scene in batch} == {f"{index:09d}" for index in range(4)}
    for shown in batch:
        scene = composed(int(shown.key))
        assert np.array_equal(coats(shown.tensors), scene.materials[scene.material_index, -1])


def test_symmetries_permute_and_scale_an_added_colour_and_leave_a_scalar() -> None:
    with declared(COAT, TINT):
        sample = toy_sample(0)
        rng = np.random.default_rng(0)
        sample.scene.materials[:, -4:] = rng.random((len(sample.scene.materials), 4))
        scene = training_scene(sample, 16)
        before = scene.tensors.material_TM[:, -4:]
        turned = permute_channels(scene, np.array([2, 0, 1])).tensors.material_TM[:, -4:]
        assert torch.equal(turned[:, 0], before[:, 0])
        assert torch.equal(turned[:, 1:], before[:, [3, 1, 2]])
        scaled = scale_light(scene, 2.0).tensors.material_TM[:, -4:]
        assert torch.equal(scaled[:, 0], before[:, 0])
        assert torch.equal(scaled[:, 1:], 2 * before[:, 1:])


def test_a_network_learns_from_it_and_is_opened_again(run: Path) -> None:
    checkpoint = run / "checkpoints" / "step-000000004.safetensors"
    pictures = []
    for place in (run, checkpoint):
        network = open_network(place)
        assert network.config.material_columns == WITH_COAT
        with torch.no_grad():
            pictures.append(network(batch_scenes([scene_tensors(composed(0))]), 16))
    assert torch.equal(*pictures)
    start = new_state(coated_run()).model.encoder.tokens.material.weight
    learnt = open_network(run).encoder.tokens.material.weight
    assert learnt.shape == start.shape == (36, 11)
    assert not torch.equal(learnt[:, -1], start[:, -1]), "no gradient reached the column"
    renderer = NeuralRenderer.load(run / "model.safetensors")
    plain, coated = tiny_scene(), tiny_scene()
    coated.materials[FLOOR, -1] = 0.9
    assert not np.array_equal(renderer.render(plain, 16), renderer.render(coated, 16))
    assert not renderer.prepare(coated).notes


def test_a_checkpoint_whose_column_is_not_declared_says_so(run: Path) -> None:
    with declared():
        for place in (run, run / "checkpoints" / "step-000000004.safetensors"):
            with pytest.raises(TrilightError, match="'coat'.*has to be declared first"):
                open_network(place)


def test_the_published_form_refuses_it(tmp_path: Path) -> None:
    config = dataclasses.replace(tiny_config("dpt"), material_columns=WITH_COAT)
    with pytest.raises(TrilightError, match="material_columns .*coat"):
        save_published(awake(config), tmp_path)


def test_the_shipped_network_gives_the_same_bytes_and_says_what_it_does_not_read() -> None:
    renderer = NeuralRenderer(open_network("builtin:"))
    assert open_network("builtin:").config.material_columns == PUBLISHED_COLUMNS
    coated = tiny_scene()
    coated.materials[FLOOR, -1] = 0.9
    with pytest.warns(UserWarning, match="does not read coat"):
        shown = renderer.render(coated, 16)
    with declared():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.array_equal(renderer.render(tiny_scene(), 16), shown)


def test_the_path_tracer_says_what_it_does_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    use_children_here(monkeypatch)
    child = RenderChild(choose_variant(), threads=1)
    tracer = PathTracer(child, FixedSamples(spp=1, denoiser="off"), 8)
    scene = tiny_scene()
    assert tracer.load(scene, "floor").notes == ()
    scene.materials[FLOOR, -1] = 0.9
    assert tracer.load(scene, "floor").notes == ("the path tracer does not read coat",)


def test_inspect_names_the_columns_in_use() -> None:
    scene = tiny_scene()
    for coat, named in ((0.9, "coat"), (0.0, None)):
        scene.materials[FLOOR, -1] = coat
        assert _facts(scene).get("added_columns") == named


def test_a_network_of_four_columns_trains_on_the_same_data(data: Dataset, tmp_path: Path) -> None:
    trained(FOUR, [str(data.folder.root)], tmp_path / "four")
    assert open_network(tmp_path / "four").encoder.tokens.material.weight.shape == (
        36,
        10,
    )

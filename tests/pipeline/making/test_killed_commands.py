"""Commands on one scene whose child is killed: they do the same again, and say the same."""

import dataclasses
import multiprocessing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.exchange.convert import convert_scene
from pipeline.exchange.open_scene import SceneSource
from pipeline.exchange.reader import SceneReader
from pipeline.making import inspect_scene as inspecting
from pipeline.making.inspect_scene import inspect_scene
from pipeline.making.path_tracer import PathTracer
from pipeline.renders.settings import RenderSettings
from pipeline.renders.variant import Variant, choose_variant
from storage.dataset.shard import write_shard
from storage.records.profiles import PROFILES
from storage.records.sample import encode_sample, sample_key
from storage.records.scene_file import encode_scene
from tests.infra.child_here import use_children_here
from tests.scenes_by_hand import tiny_sample, tiny_scene


def kill_children() -> int:
    """Kill every child of this process; return how many there were."""
    children = multiprocessing.active_children()
    for child in children:
        child.kill()
        child.join()
    return len(children)


@pytest.fixture
def source(tmp_path: Path) -> SceneSource:
    path = tmp_path / "scene.safetensors"
    path.write_bytes(encode_scene(tiny_scene()))
    return SceneSource(path=path, key=None)


def test_reading(source: SceneSource) -> None:
    with SceneReader() as reader:
        for _ in range(2):
            assert encode_scene(reader.load(source).scene) == encode_scene(tiny_scene())
            assert kill_children()


def test_converting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two scenes of a shard; the child is killed between them. Expected is what no child made."""
    shard, profile = tmp_path / "train-000000.tar", PROFILES[0]
    samples = [dataclasses.replace(tiny_sample(seed=n), key=sample_key(n)) for n in range(2)]
    write_shard(shard, [(sample.key, encode_sample(sample, profile)) for sample in samples])

    def converted(folder: Path, between: Callable[[], object]) -> list[bytes]:
        folder.mkdir()
        target = folder / "scene.safetensors"
        source = SceneSource(path=shard, key=None)

        def done(finished: int, of: int) -> None:
            between()

        found = convert_scene(source, target, budget=None, done=done)
        return [path.read_bytes() for path in found.files]

    kills: list[int] = []

    def kill_once() -> None:
        if not kills:
            kills.append(kill_children())

    with monkeypatch.context() as patch:
        use_children_here(patch)
        whole = converted(tmp_path / "whole", lambda: 0)
    assert len(whole) == 2
    assert converted(tmp_path / "killed", kill_once) == whole
    assert kills == [1]


def test_inspecting(source: SceneSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The child is killed between the facts and the pictures."""

    def kill_and_choose() -> Variant:
        assert kill_children()
        return choose_variant()

    monkeypatch.setattr(inspecting, "choose_variant", kill_and_choose)
    monkeypatch.setattr(inspecting, "_turntable", _grey)
    assert inspect_scene(source, tmp_path / "sheet.png").facts["views"] > 0
    assert (tmp_path / "sheet.png").exists()


def _grey(source: SceneSource, variant: Variant) -> NDArray[np.uint8]:
    return np.full((2, 4, 3), 128, np.uint8)


def test_rendering() -> None:
    """The child is killed between two passes of samples; the next one opens the scene again."""
    scene, kills = tiny_scene(), list[int]()
    settings = RenderSettings(resolution=8, min_spp=16, max_spp=64, noise_floor_db=99.0)
    disturbed = False

    def sampled(step: object) -> None:
        if disturbed and not kills:
            kills.append(kill_children())

    def picture() -> NDArray[np.float32]:
        return tracer.render(scene.c2w[0], float(scene.fov_deg[0]), "a view").radiance_rgb

    tracer = PathTracer(settings, seed=0, variant=choose_variant(), threads=1, sampled=sampled)
    try:
        tracer.open(scene, "a scene")
        undisturbed = picture()
        disturbed = True
        assert np.array_equal(picture(), undisturbed)
        assert kills == [1]
    finally:
        tracer.close()

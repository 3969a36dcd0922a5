"""The benchmark of codecs on samples made by hand: every side runs, and the report is whole."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from infra.bench import shards, shards_report
from infra.bench.harness import Options
from infra.bench.shard_arrays import COLOURS, coloured
from storage.sample import Sample
from tests.documents.dataset_by_hand import furnished
from tests.scenes_by_hand import tiny_sample

OPTIONS = Options(quick=True, objects=("builtin:",), allowed_licences=())


def _samples(build: object, options: Options, count: int, done: Callable[[], None]) -> list[Sample]:
    scene = furnished(["a", "b"])
    for _ in range(count):
        done()
    return [dataclasses.replace(tiny_sample(str(k), 32, seed=k), scene=scene) for k in range(count)]


def test_a_small_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(shards, "rendered_samples", _samples)
    rounds: list[None] = []
    result = shards.run(OPTIONS, lambda: rounds.append(None))
    assert len(rounds) == shards.num_rounds(OPTIONS)
    lines = dict(shards_report.rows(result))
    assert "100% lawful" in lines["ZIP"]
    assert "100% lawful" in lines["profile compact"]
    assert "a second" in lines["sample HDF5 float16"]
    # textures of 13 x 32 x 32 float32 against 40 bytes of a row; vertices are a small part
    memory = result.sides["arrays HDF5 float32, as drawn"]["memory_bytes"].median
    assert memory > 13 * 1024 * 4 * 7
    assert memory / result.sides["arrays indexed, as drawn"]["memory_bytes"].median > 50
    shards_report.plot(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


@pytest.mark.parametrize(("colours", "rows"), list(zip(COLOURS, (6, 4, 7), strict=True)))
def test_other_colours_keep_the_laws(colours: str, rows: int) -> None:
    """Floor, light and two objects of two triangles: objects, or triangles, are counted."""
    scene = furnished(["a", "b"])
    other = coloured(scene, colours)
    other.check()
    assert len(other.materials) == rows
    assert np.array_equal(other.triangle_emits, scene.triangle_emits)
    assert len(scene.materials) == 6

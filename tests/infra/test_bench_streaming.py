"""The benchmark of streaming on samples made by hand: every side runs, and the report is whole."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from infra.bench import streaming, streaming_report
from infra.bench.harness import Options
from storage.sample import Sample
from tests.train.toy import toy_sample

pytest.importorskip("aiohttp", reason="http needs the package aiohttp")

OPTIONS = Options(quick=True, objects=("builtin:",), allowed_licences=())


def _samples(build: object, options: Options, count: int, done: Callable[[], None]) -> list[Sample]:
    for _ in range(count):
        done()
    made = toy_sample(0, resolution=64, views=4)
    return [dataclasses.replace(made, key=str(index)) for index in range(count)]


@pytest.mark.slow
def test_a_small_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(streaming, "rendered_samples", _samples)
    monkeypatch.setattr(streaming, "MANIFESTS", (20, 3000))
    monkeypatch.setattr(streaming_report, "MANIFESTS", (20, 3000))
    rounds: list[None] = []
    result = streaming.run(OPTIONS, lambda: rounds.append(None))
    assert len(rounds) == streaming.num_rounds(OPTIONS)
    cold, warm = result.sides[streaming.COLD], result.sides[streaming.WARM]
    whole = cold["bytes_per_sample"].median
    # every shard comes once, with a manifest and heads that are small beside it
    assert whole < cold["wire_bytes_per_sample"].median < 1.2 * whole
    assert warm["wire_bytes_per_sample"].median < 0.2 * whole
    lines = dict(streaming_report.rows(result))
    assert "of cat" in lines[streaming.OFF]
    assert "on the wire" in lines[streaming.COLD]
    assert "samples a second" in lines[streaming.APART]
    assert "MB held" in lines["opening 3,000 samples"]
    streaming_report.plot(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000

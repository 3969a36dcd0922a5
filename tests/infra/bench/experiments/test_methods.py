"""Pictures come nearer with samples and with what is traced."""

from pathlib import Path

import pytest

from infra.bench.experiments import methods
from tests.infra.bench.bench_kit import measured_rows


@pytest.mark.slow("benchmarks")
def test_methods_come_nearer_with_samples_and_with_what_is_traced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a hundred objects of the benchmark take minutes to prepare, and one scene uses few of them
    monkeypatch.setattr(methods, "BENCHMARK", "builtin:12")
    monkeypatch.setattr(methods, "WIDTHS", (32,))
    found = measured_rows("methods", tmp_path)
    db = {name: row.values["psnr_log_db, dB"] for name, row in found.items()}
    assert db["32 px, 16 samples, fast"] > db["32 px, 1 sample, fast"]
    cost = {name: row.values["a further view, core-s"] for name, row in found.items()}
    assert cost["32 px, direct light, no network"] < cost["32 px, all traced light, no network"]
    # of one row they are milliseconds, which vary by more than loading a tiny scene takes
    firsts = [row.values["a scene's first view, core-s"] for row in found.values()]
    assert sum(firsts) > sum(cost.values())
    assert not found["32 px, network builtin:"].intervals and len(found) == 10

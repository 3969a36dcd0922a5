"""What is said before work begins: predictions of a dataset, and what a machine lacks."""

import dataclasses
import os
import re
from pathlib import Path
from unittest import mock

import pytest

from infra.cli import doctor
from infra.planning import describe_run, measure_scenes, predict_cost
from pipeline.executors.threads import ThreadRunner
from pipeline.flows import prefect_server
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import MAX_TASKS
from pipeline.generation.pipeline import make_dataset
from pipeline.isolation import confinement
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import read_status
from storage.dataset.shard import scan_members
from storage.machine import available_cores
from tests.for_each import case
from tests.pipeline.generation.tiny_scenes_kit import Undocumented, tiny_order, without_rendering


def _measured(core_s: tuple[float, ...], num_bytes: int = 150_000) -> list[tuple[float, int]]:
    return [(seconds, num_bytes) for seconds in core_s]


def test_equal_scenes_add_up_exactly_and_two_million_come_with_warnings() -> None:
    """The first scene, which compiles, is left out; nothing varies, so intervals are points."""
    order = GenerateOptions(build="pretrain-256", scenes=2560)
    found = predict_cost(_measured((99.0, 36.0, 36.0)), order, cores=16, usd_per_core_hour=0.5)
    assert (found.num_scenes, found.num_shards) == (2560, 10)
    assert found.core_hours.value == pytest.approx(25.6)  # floating point only
    assert (found.core_hours.low, found.core_hours.high) == pytest.approx((25.6, 25.6))
    assert found.hours.value == pytest.approx(1.6)
    assert found.usd.value == pytest.approx(12.8)
    assert found.gigabytes.value == pytest.approx(0.384)
    assert found.num_tasks <= MAX_TASKS
    assert found.notes == ()
    order = GenerateOptions(build="pretrain-256", scenes=2_000_000)
    measured = _measured((400.0, 400.0))
    found = predict_cost(measured, order, cores=4096, usd_per_core_hour=0.04)
    assert found.num_tasks == MAX_TASKS
    assert found.manifest_mb < 2  # it lists 7,813 shards, however many views they hold
    assert any("flow runs" in note for note in found.notes)
    fewer = predict_cost(
        measured, dataclasses.replace(order, scenes=500), cores=1, usd_per_core_hour=1
    )
    assert fewer.notes == ()


def test_an_interval_covers_the_mean_as_often_as_it_says() -> None:
    """Of 200 sets of 40 lognormal scenes; 90 % stated, and a bootstrap of 40 falls a little short:
    at least 80 % here leaves room for that and for the binomial spread of 2 %."""
    import numpy as np

    rng = np.random.default_rng(0)
    order = GenerateOptions(build="smoke", scenes=3600)
    truth = float(np.exp(0.5 * 0.6**2))
    hits = 0
    for _ in range(200):
        core_s = tuple(float(value) for value in rng.lognormal(0.0, 0.6, 41))
        interval = predict_cost(_measured(core_s), order, cores=1, usd_per_core_hour=1).core_hours
        assert interval.low <= interval.value <= interval.high
        hits += interval.low <= truth <= interval.high
    assert hits >= 160


def test_what_is_measured_are_the_first_scenes_of_the_dataset_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten scenes reach the third shard, which is for validation. The clock moves on by 1000 s for
    the first scene, which a prediction leaves out, and by its number for each other one."""
    clock = mock.Mock(**{"monotonic.return_value": 0.0})
    monkeypatch.setattr("pipeline.generation.pipeline.time", clock)

    def work(scene: int) -> None:
        clock.monotonic.return_value += scene or 1000

    scenes = without_rendering(monkeypatch, work)
    order = tiny_order(out=str(tmp_path / "set"), scenes=24)
    measured = measure_scenes(order, 10, tmp_path / "measured", lambda: None)
    assert not (tmp_path / "set").exists()
    cores = available_cores()
    core_s, num_bytes = zip(*measured, strict=True)
    assert core_s == tuple(cores * seconds for seconds in (1000, *range(1, 10)))
    sampled = list(scenes)
    scenes.clear()
    make_dataset(order, Undocumented())
    assert sampled == scenes[:10]
    by_key: dict[str, int] = {}
    for shard in open_dataset(str(tmp_path / "set")).manifest.shards:
        with (tmp_path / "set" / shard.name).open("rb") as stream:
            for member in scan_members(stream, shard.name):
                size = 512 + -(-member.num_bytes // 512) * 512
                by_key[member.key] = by_key.get(member.key, 0) + size
    expected = [size for _, size in sorted(by_key.items())]
    assert num_bytes == tuple(expected[:10])
    found = predict_cost(measured, order, cores=1, usd_per_core_hour=1)
    assert found.core_hours.value == pytest.approx(24 * cores * 5 / 3600)  # floating point only


def test_what_a_run_will_make_is_said_before_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_rendering(monkeypatch)
    order, folder = tiny_order(out=str(tmp_path), scenes=3), DatasetFolder(tmp_path)
    lacking = "no shard is for validation before --scenes 9"
    monkeypatch.setenv("TRILIGHT_CORES", "3")
    rough = (
        "once objects are prepared, roughly 1 minute on 3 cores, where scenes cost what ours did"
    )
    scenes = f"3 scenes of 2 views each in 1 shard ({lacking})"
    assert describe_run(order, folder) == f"{scenes}; {rough}; `trilight plan` measures it"
    for build, said in (("smoke", "3 minutes"), ("textured-256", "94 hours")):
        text = describe_run(GenerateOptions(build=build, out=str(tmp_path / build)), folder)
        assert f"roughly {said} on 3 cores" in text
    assert lacking in make_dataset(order, ThreadRunner()).notes
    said = describe_run(dataclasses.replace(order, scenes=9, shards="1:3"), folder)
    assert said.startswith("9 scenes of 2 views each in 3 shards, of which this run makes 1:3")
    fewer = dataclasses.replace(order, scenes=2)
    kept = "the dataset keeps its 3 scenes; for 2, choose another --out"
    assert f"({kept})" in describe_run(fewer, folder)
    assert kept in make_dataset(fewer, ThreadRunner()).notes
    asked = read_status(str(tmp_path)).asked
    assert asked and asked[asked.index("--scenes") + 1] == "3"
    assert re.search(r"; 6 of them are still to make: [\d.]+ \([\d.]+ to [\d.]+\) minutes on", said)


FACTS = {"denoiser": "2.5.1", "denoiser_device": "CPU", "threads": "2", "view_s": "0.04"}


def _responds(code: str, text: str, consequence: str, mend: str) -> doctor.Finding:
    compile(code, text, "exec")
    return doctor.Finding("ok", text)


@pytest.mark.slow("packaging")
def test_a_machine_that_passes_tests_lacks_nothing() -> None:
    assert [finding for finding in doctor.examine() if finding.state == "missing"] == []


def test_a_user_without_a_home_has_one_in_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/x")
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    prefect_server._ensure_home()
    assert os.environ["HOME"] == str(tmp_path / "home")
    for name in ("TRILIGHT_CACHE", "HOME"):
        monkeypatch.delenv(name)
    monkeypatch.setattr(doctor, "CHECKS", {"orchestrator": doctor._orchestrator})
    (finding,) = doctor.examine()
    assert "has no home directory" in finding.found


def test_findings_come_one_by_one_and_none_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The probes take seconds each; who waits sees the first at once, and what is looked at."""
    told: list[str] = []
    found = doctor.examine(told.append)
    assert next(found).name == "machine"
    assert told == ["machine"]
    assert next(found).name == "disk"
    assert told == ["machine", "disk"]
    # Probes would take seconds in processes; what is not well has its consequence and cure.
    monkeypatch.setattr(doctor, "_probe", _responds)
    monkeypatch.setattr(doctor, "render_facts", lambda variant: FACTS)
    findings = list(doctor.examine())
    assert [finding.name for finding in findings] == list(doctor.CHECKS)
    for finding in findings:
        assert finding.state != "missing", finding
        assert bool(finding.consequence) == bool(finding.mend) == (finding.state != "ok")


def test_what_confines_children_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for word, version, state, said in [
        ("auto", 7, "ok", "Landlock 7, seccomp"),
        ("off", 7, "slower", "TRILIGHT_CONFINE=off"),
        ("auto", 0, "slower", "seccomp"),
        ("required", 0, "missing", "seccomp"),
    ]:
        with case(said):
            monkeypatch.setenv("TRILIGHT_CONFINE", word)
            for module in (doctor, confinement):
                monkeypatch.setattr(module, "landlock_version", lambda version=version: version)
                monkeypatch.setattr(module, "seccomp_works", lambda: True)
            finding = doctor._confinement()
            assert (finding.state, finding.found.endswith(said)) == (state, True)


def test_a_probe_that_fails_and_no_llvm_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    for code, said in {
        "raise SystemExit('filters are gone')": "filters are gone",
        "import os; os.abort()": "ended with status -6",
        "import nothing_of_that_name": "No module named 'nothing_of_that_name'",
    }.items():
        with case(code):
            finding = doctor._probe(code, "x 1", "no x", "get x")
            assert finding.state == "missing"
            assert said in finding.found
    monkeypatch.setattr("pipeline.renders.mitsuba_variant.llvm_libraries", list)
    monkeypatch.setattr(doctor, "_probe", _responds)
    monkeypatch.setattr(doctor, "CHECKS", {"renderer": doctor._renderer})
    (finding,) = doctor.examine()
    assert finding.state == "missing"
    assert "no LLVM library found" in finding.found and "karellen-llvm-core" in finding.found


@pytest.mark.parametrize("note", ["", "the GPU is too old, so the CPU denoises pictures"])
def test_a_gpu_is_well_or_says_what_it_lacks(note: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipeline.renders.mitsuba_variant import Variant

    gpu = Variant(name="cuda_ad_rgb", libllvm="", note=note, denoiser="CPU" if note else "CUDA")
    monkeypatch.setattr(doctor, "choose_variant", lambda default="cpu", device=None: gpu)
    monkeypatch.setattr(doctor, "query_gpus", lambda fields: ["NVIDIA H200, 580.95"])
    monkeypatch.setattr(doctor, "_probe", _responds)
    monkeypatch.setattr(
        doctor, "render_facts", lambda variant: {**FACTS, "denoiser_device": variant.denoiser}
    )
    assert doctor._renderer().state == "ok"
    finding = doctor._denoiser()
    assert (finding.state, finding.consequence) == ("slower" if note else "ok", note)
    assert f"{gpu.denoiser}, 2 threads; a view of 256 pixels" in finding.found
    finding = doctor._accelerator()
    assert (finding.state, finding.found[:31]) == ("ok", "NVIDIA H200, driver 580.95; ren")


def test_a_gpu_that_renders_nothing_right_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    monkeypatch.setattr(doctor, "query_gpus", lambda fields: ["NVIDIA H200, 580.95"])
    finding = doctor._accelerator()
    assert finding.state == "slower" and "no right picture" in finding.found

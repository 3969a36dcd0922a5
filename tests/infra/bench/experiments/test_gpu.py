"""Steps are of the presets' own sizes on a GPU and of small ones here; a failure has no figures."""

import dataclasses

import pytest
import torch

from infra.bench.gpu import steps
from infra.bench.gpu.step_profile import REST, parts_ms
from infra.bench.gpu.steps import step_figures, step_settings
from infra.bench.gpu.twin import NETWORKS, twin_figures
from tests.for_each import case
from train.runs import RUNS, named_run

CPU = torch.device("cpu")


def test_every_preset_has_its_own_size_on_a_gpu_and_a_small_one_here() -> None:
    for run in RUNS:
        with case(run):
            settings = named_run(run)
            on_gpu = step_settings(run, torch.device("cuda"))
            assert on_gpu == dataclasses.replace(settings, from_weights=False)
            small = step_settings(run, CPU)
            assert small.model.view_stage == settings.model.view_stage
            assert small.model.head == settings.model.head
            assert (small.loss, small.precision) == (settings.loss, settings.precision)


def test_lpips_is_no_part_of_the_loss_in_the_sum() -> None:
    found = parts_ms(120.0, {"loss": 50.0, "LPIPS": 30.0})
    assert found == {REST: 0.07, "LPIPS": 0.03, "loss": 0.02}


def test_too_little_memory_has_no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def drawn(settings: object, scenes: int) -> None:
        asked.append(scenes)
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(steps, "drawn_batch", drawn)
    assert step_figures("smoke", 1, CPU) == ({}, {})
    assert asked[-1] == 1, "fewer scenes were tried, down to one"


@pytest.mark.slow("benchmarks")
def test_a_built_in_network_shows_its_stored_picture_here() -> None:
    for network in NETWORKS:
        with case(network):
            found = twin_figures(network, "float32", CPU)
            assert found["db"] > 55 and found["ms"] > 0, "float16 of what another processor made"


@pytest.mark.slow("benchmarks")
def test_steps_are_timed_with_their_parts() -> None:
    for run in ("smoke", "finetune", "hits"):
        with case(run):
            figures, parts = step_figures(run, 1, CPU)
            assert figures["ms"] > 0 and figures["kernels"] > 100
            assert {"loss", "optimiser", REST} <= set(parts)

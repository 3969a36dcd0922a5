"""Steps of a run: on the processor, on a card that is not there, and where memory lacks."""

import dataclasses
from collections import Counter
from pathlib import Path

import pytest
import torch

from infra.bench.card.drawn_batch import workloads
from infra.bench.card.effort import CARD, PROCESSOR, sized
from infra.bench.card.predicted import h100_row, least_ms
from infra.bench.card.step_profile import REST, kind_of, summed
from infra.bench.card.ten_steps import steps_of_run
from model.costs import training_flops
from tests.for_each import case
from tests.infra.bench.card import fake_cases
from tests.train.fake_card import card_process
from train.runs import RUNS, named_run

SHORT = dataclasses.replace(PROCESSOR, steps=1, warm_steps=0)


def test_every_run_has_its_own_size_on_a_card_and_a_small_one_here() -> None:
    for run in RUNS:
        settings = named_run(run)
        assert sized(settings, CARD) == settings
        small = sized(settings, PROCESSOR)
        assert small.model.view_stage == settings.model.view_stage
        assert small.model.head == settings.model.head
        assert (small.loss, small.precision) == (settings.loss, settings.precision)


def test_the_least_time_is_that_of_the_products() -> None:
    settings = sized(named_run("pretrain"), PROCESSOR)
    found = least_ms("pretrain", 1, PROCESSOR, {"bfloat16": 1e9})
    (workload,) = workloads(settings, 1)
    assert found == pytest.approx(1e3 * training_flops(settings.model, workload) / 1e9)
    assert least_ms("pretrain", 1, PROCESSOR, {"float32": 1e9}) is None


@pytest.mark.slow("benchmarks")
def test_on_a_card_with_too_little_memory_fewer_scenes_are_taken(tmp_path: Path) -> None:
    """All of a step on the card that is not there: LPIPS, Muon, a DPT head, bfloat16."""
    with card_process(tmp_path) as process:
        enough, little = (
            process.submit(fake_cases.steps_with_memory_for, scenes, run, SHORT).result()
            for scenes, run in ((1, "finetune"), (0, "smoke"))
        )
    assert (enough["asked_scenes"], enough["scenes"]) == (2, 1)
    assert enough["lpips"] and enough["muon"] and enough["peak_gib"] == 3
    assert enough["profile"]["of"] == "cuda:0"
    assert enough["not_compiled"]["kernels"] == 7, "kernel by kernel too: what compiling brings"
    assert little["failed"] == "too little memory, even for one scene a pass"


def test_a_run_that_fails_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("CUDA error: an illegal memory access")

    monkeypatch.setattr("infra.bench.card.ten_steps.drawn_batch", broken)
    found = steps_of_run("smoke", SHORT, torch.device("cpu"))
    assert found["failed"] == "RuntimeError: CUDA error: an illegal memory access"


KINDS = [
    ("void pytorch_flash::flash_fwd_kernel<Flash_fwd_kernel_traits<128>>", "attention"),
    ("fmha_cutlassF_bf16_aligned_64x128_rf_sm80(PyTorchMemEffAttention)", "attention"),
    ("nvjet_hsh_128x256_64x4_2x1_v_bz_coopA_NTT", "product"),
    ("cudnn_generated_fort_native_sdpa_sm90_flash_bprop_wgmma_f16_knob_26", "attention"),
    ("cudnn_generated_fort_native_sdpa_sm90_knob_3", "attention"),
    ("ampere_bf16_s16816gemm_bf16_128x128_ldg8_f2f_stages_32x5_tn", "product"),
    ("sm80_xmma_fprop_implicit_gemm_indexed_tf32f32", "product"),
    ("void cudnn::ops::nchwToNhwcKernel<float>", "convolution"),
    ("void at::native::(anonymous namespace)::multi_tensor_apply_kernel", "optimiser"),
    ("Memcpy HtoD (Pageable -> Device)", "copy or cast"),
    ("void at::native::vectorized_elementwise_kernel<4, MulFunctor>", "elementwise"),
    ("aten::mm", "product"),
    ("aten::mul", "elementwise"),
]


def test_kernels_are_of_a_kind_by_their_names() -> None:
    for name, kind in KINDS:
        with case(name):
            assert kind_of(name) == kind


def test_lpips_is_no_part_of_the_loss_in_the_sum() -> None:
    rows = [("gemm", 60.0), ("add", 40.0), ("add", 20.0)]
    found = summed(rows, Counter({"loss": 50.0, "LPIPS": 30.0}))
    assert found["by_part_ms"] == {REST: 0.07, "LPIPS": 0.03, "loss": 0.02}
    assert found["by_kind_ms"] == {"product": 0.06, "elementwise": 0.06}
    assert (found["kernels"], found["total_ms"]) == (3, 0.12)
    assert found["dearest"][1] == {"name": "add", "calls": 2, "ms": 0.06}


def test_the_roofline_of_a_run_stands_beside_it() -> None:
    """As many scenes in a pass, or none: a step of other size is no prediction of this one."""
    found = h100_row("pretrain", 16)
    assert found is not None and found["ms"] > 50 and found["kernels"] > 500
    assert h100_row("pretrain", 15) is None
    assert h100_row("no such run", 16) is None

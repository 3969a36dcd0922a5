"""Every named run takes its step on a graphics card, and every named size, without a card.

On tensors without numbers (fake_card): forward, loss with LPIPS, backward, clipping, AdamW and
Muon, running mean, validation, evaluation, checkpoint, export. No processor can show what these
show: a module that stayed behind, a norm that answers in another type there.
"""

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
import torch

from model.config import SIZES
from model.renderformer import RenderFormer
from tests.train import card_cases
from tests.train.loss.test_lpips import small_weights
from tests.train.toy import write_toy_dataset
from train.loss.lpips import LINEAR_FILE, VGG16_FILE
from train.runs import RUNS

PLAIN = ("smoke", "tiny", "small", "base", "large")
CASES = {
    "smoke": PLAIN, "pretrain": PLAIN, "builtin": ("smoke",), "finetune": ("base",),
    "paper-pretrain": ("smoke", "base"), "paper-finetune": ("base",),
    "paper-pretrain-large": ("large",), "paper-finetune-large": ("large",),
    "hits": ("hits-smoke", "hits-base"), "hits-tokens": ("hits-smoke",), "hits-256": ("hits-base",),
}  # fmt: skip
"""Every run at its own size, and every size with AdamW (`smoke`) and with Muon (`pretrain`)."""

QUICK = {
    "smoke": "smoke", "builtin": "smoke", "paper-pretrain": "smoke", "pretrain": "tiny",
    "hits": "hits-smoke",
}  # fmt: skip
"""Every kind of step. Second stages step as the first ones do, and `small` and `base` are a larger
`tiny`; the windows of `large` take half a minute, and are with the slow tests."""


def test_every_run_and_every_size_is_among_the_cases() -> None:
    assert set(CASES) == set(RUNS)
    assert {size for sizes in CASES.values() for size in sizes} == set(SIZES)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("toy")
    write_toy_dataset(folder, train=2, validation=2, resolution=card_cases.RESOLUTION)
    return str(folder)


@pytest.fixture(scope="module")
def lpips(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder of files like the published ones, with few channels."""
    folder = tmp_path_factory.mktemp("lpips")
    for name, weights in zip((VGG16_FILE, LINEAR_FILE), small_weights(), strict=True):
        torch.save(weights, folder / name)
    return str(folder)


@pytest.mark.parametrize(
    ("run", "size"),
    [
        pytest.param(run, size, marks=[] if QUICK.get(run) == size else pytest.mark.slow)
        for run, sizes in CASES.items()
        for size in sizes
    ],
)
def test_every_run_of_every_size_works_on_a_card(
    run: str, size: str, card: ProcessPoolExecutor, data: str, lpips: str, tmp_path: Path
) -> None:
    card.submit(card_cases.train_and_judge, run, size, data, lpips, tmp_path).result()


def test_a_run_goes_on_and_a_second_one_begins_on_a_card(
    card: ProcessPoolExecutor, data: str, lpips: str, tmp_path: Path
) -> None:
    card.submit(card_cases.resume, data, lpips, tmp_path).result()


@pytest.mark.slow  # a rival is traced as well
def test_evaluate_has_everything_on_the_card(
    card: ProcessPoolExecutor, data: str, lpips: str, tmp_path: Path
) -> None:
    asked = card.submit(card_cases.evaluate_command, data, lpips, tmp_path).result()
    assert asked == {"RenderFormer": {"cuda"}, "Lpips": {"cuda"}}


@pytest.mark.parametrize("size", ["smoke", "tiny"])
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_bfloat16_rounds_neither_rays_nor_materials_nor_the_last_layers(
    size: str, device: str, card: ProcessPoolExecutor
) -> None:
    """As model.precision says, with a linear head and with a DPT; norms keep the type they get."""
    if device == "cuda":
        types = card.submit(card_cases.types_on_the_card, size).result()
    else:
        types = card_cases.types_under_autocast(RenderFormer(SIZES[size]()))
    exact = {"encoder.tokens.material", "encoder.tokens.normal", "decoder.rays"}
    exact |= {"decoder.head.last"} | ({"decoder.head.widen"} if size == "tiny" else set())
    assert {name: types[name] for name in exact} == dict.fromkeys(exact, "float32")
    assert types["picture"] == "float32"
    norms = {name: kind for name, kind in types.items() if name.endswith("norm")}
    assert len(norms) > 10 and set(norms.values()) == {"kept"}
    assert types["decoder.layers.0.ffn.down"] == "bfloat16", "and the layers are rounded"


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        ("processor", "Expected all tensors to be on the same device|two devices"),
        ("numpy", "can't convert cuda:0"),
        ("unique", "unique"),
    ],
)
def test_the_card_forgives_nothing(mistake: str, message: str, card: ProcessPoolExecutor) -> None:
    with pytest.raises(Exception, match=message):
        card.submit(card_cases.mixed_on_the_card, mistake).result()

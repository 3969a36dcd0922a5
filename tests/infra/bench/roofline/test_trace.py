"""What is counted is what is asked for: by hand for one layer, by model.costs for a step."""

from concurrent.futures import ProcessPoolExecutor

import pytest

from infra.bench.roofline.cards import CARDS
from infra.bench.roofline.case import Case
from infra.bench.roofline.fusion import fused
from infra.bench.roofline.prediction import predicted
from infra.bench.roofline.row import COMPILED
from infra.bench.roofline.step import PADDING, UNSTATED_TRIANGLES
from model.costs import Workload, training_flops
from storage.errors import TrilightError
from tests.infra.bench.roofline import card_steps
from tests.infra.bench.roofline.card_steps import ROWS, WIDTH
from train.runs import named_run

X, W, B = 4 * ROWS * WIDTH, 4 * WIDTH * WIDTH, 4 * WIDTH


def test_every_kernel_of_a_known_block_is_counted(card: ProcessPoolExecutor) -> None:
    traced, peak = card.submit(card_steps.known_block).result()
    layer = [k for k in traced.kernels if k.part == ("layer", 1)]
    forward = [(k.kind, k.num_bytes) for k in layer if not k.is_backward]
    casts = sorted([("cast", 3 * each // 2) for each in (X, W, B)])
    assert sorted(each for each in forward if each[0] == "cast") == casts
    product, relu = (each for each in forward if each[0] != "cast")
    assert product == ("product", X // 2 + W // 2 + B // 2 + X // 2)
    assert relu == ("pointwise", X)
    back = [k for k in layer if k.is_backward]
    assert [k.kind for k in back].count("product") == 1, "nobody asks for the gradient of x"
    assert sum(k.flops for k in layer) == 2 * 2 * ROWS * WIDTH * WIDTH
    assert {k.product_type for k in layer if k.flops} == {"bfloat16"}
    assert traced.waits == 1, "two numbers that come together are one wait"
    assert peak >= X + W + B + X // 2 + W // 2


def test_a_step_asks_for_the_products_that_costs_say(card: ProcessPoolExecutor) -> None:
    traced = card.submit(card_steps.small_step, "float32").result()
    settings = named_run("smoke")
    exact = 0
    for share in (0, PADDING):
        work = Workload(
            triangles=round(UNSTATED_TRIANGLES * (1 - share)),
            views=settings.views_per_scene,
            resolution=settings.resolution,
        )
        exact += training_flops(settings.model, work)
    found = 0.0
    for kernel in traced.kernels:
        if kernel.part[0]:  # the way back of attention has five products, one of them once more
            again = kernel.kind == "attention" and kernel.is_backward
            found += kernel.flops * (4 / 5 if again else 1)
    assert exact <= found <= 1.08 * exact, "the rest is padding"


def test_in_few_bits_nothing_is_masked_and_no_step_waits_for_the_card(
    card: ProcessPoolExecutor,
) -> None:
    traced = card.submit(card_steps.small_step, "bfloat16").result()
    settings = named_run("smoke").model
    attention = [k.name for k in traced.kernels if k.kind == "attention"]
    layers = settings.encoder_layers + 2 * settings.decoder_layers
    assert len(attention) == 2 * layers
    assert not any("efficient" in name for name in attention)
    packed = settings.encoder_layers + settings.decoder_layers
    assert sum("varlen" in name for name in attention) == 2 * packed
    assert (traced.waits, traced.window_waits) == (0, 1)
    assert {"aten::_fused_adamw_", "aten::_foreach_copy_"} <= card_steps.names(traced.kernels)

    card_h100 = CARDS["H100-80"]
    eager = predicted(traced, card_h100)
    compiled = predicted(fused(traced, lambda part: part[0] in COMPILED), card_h100)
    assert compiled.teraflops == eager.teraflops
    assert compiled.kernels < 0.7 * eager.kernels
    assert compiled.gigabytes < eager.gigabytes and compiled.peak_gib <= eager.peak_gib
    assert sum(compiled.by_part_ms.values()) == pytest.approx(compiled.milliseconds)


def test_a_row_is_of_a_run_a_size_and_a_card(card: ProcessPoolExecutor) -> None:
    rows = [
        card.submit(card_steps.row, Case(run="smoke", card=name)).result()
        for name in ("A100-40", "H200-141")
    ]
    slow, quick = rows
    assert slow.kernels == quick.kernels and slow.milliseconds > quick.milliseconds
    fit = slow.scenes_that_fit
    assert 0 < fit["A100-40"] < fit["H100-80"] < fit["H200-141"]
    with pytest.raises(TrilightError, match="H100-80"):
        card.submit(card_steps.row, Case(run="smoke", card="H100")).result()

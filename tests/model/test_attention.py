"""Law: the fast attention is the slow one, in value and gradient, for every shape and mask."""

import torch
from torch import Tensor

from model.attention import attend
from tests.for_each import for_each
from tests.model.attention_reference import attend_reference

SHAPES = [(1, 1, 1, 1, 2), (2, 2, 5, 7, 6), (3, 1, 17, 33, 8), (1, 4, 64, 130, 16)]
"""(B, H, Q, N, D): one token, odd sizes, and more keys than a kernel's block."""

MASKS = ["none", "all", "first only", "random", "ragged"]


def make_mask(kind: str, scenes: int, keys: int) -> Tensor | None:
    generator = torch.Generator().manual_seed(3)
    mask = torch.ones(scenes, keys, dtype=torch.bool)
    if kind == "none":
        return None
    if kind == "first only":
        mask[:, 1:] = False
    if kind == "random":
        mask = torch.rand(scenes, keys, generator=generator) < 0.5
        mask[:, -1] = True
    if kind == "ragged":
        mask = torch.arange(keys) < torch.arange(1, scenes + 1)[:, None] * keys / scenes
        mask[:, 0] = True
    return mask


@for_each("kind", MASKS)
@for_each("shape", SHAPES)
@for_each(
    ("dtype", "tolerance"),
    # Sums of up to 130 products: rounding of the dtype (1e-16, 6e-8) times their number.
    [(torch.float64, 1e-13), (torch.float32, 1e-5)],
)
def test_fast_attention_equals_its_slow_twin(
    shape: tuple[int, ...], kind: str, dtype: torch.dtype, tolerance: float
) -> None:
    scenes, heads, queries, keys, width = shape
    generator = torch.Generator().manual_seed(1)
    sizes = [(scenes, heads, length, width) for length in (queries, keys, keys, queries)]
    q, k, v, upstream = (torch.randn(s, generator=generator, dtype=dtype) for s in sizes)
    mask = make_mask(kind, scenes, keys)
    results = []
    for function in (attend, attend_reference):
        inputs = [x.clone().requires_grad_() for x in (q, k, v)]
        output = function(inputs[0], inputs[1], inputs[2], mask)
        gradients = torch.autograd.grad(output, inputs, upstream)
        results.append([output.detach(), *gradients])
    for fast, slow in zip(*results, strict=True):
        torch.testing.assert_close(fast, slow, rtol=0, atol=tolerance)


def test_a_masked_key_has_neither_influence_nor_gradient() -> None:
    generator = torch.Generator().manual_seed(2)
    q, k, v = (torch.randn(1, 2, 4, 6, generator=generator) for _ in range(3))
    k.requires_grad_()
    mask = torch.tensor([[True, True, False, True]])
    attend(q, k, v, mask).sum().backward()
    assert k.grad is not None
    assert torch.all(k.grad[:, :, 2] == 0)
    assert torch.any(k.grad[:, :, 1] != 0)

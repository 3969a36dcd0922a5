"""Attention, whole and in windows, is its slow twin, in value and gradient."""

from functools import partial

import torch
from torch import Tensor

from model.attention import attend
from model.layers import SelfAttention
from model.windows import attend_in_windows, cut_windows
from tests.for_each import for_each
from tests.model.attention_reference import attend_reference
from tests.model.kit import value_and_gradients

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
    results = (
        value_and_gradients(function, (q, k, v), upstream, mask)
        for function in (attend, attend_reference)
    )
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


CPU = torch.device("cpu")


def rolled_and_masked(q: Tensor, k: Tensor, v: Tensor, width: int, shifted: bool) -> Tensor:
    """Return Swin attention as Liu et al. 2021, section 3.2, describe it, window by window."""
    side = round(q.shape[2] ** 0.5)
    shift = width // 2 if shifted else 0
    grids = [x.unflatten(2, (side, side)).roll((-shift, -shift), dims=(2, 3)) for x in (q, k, v)]
    # regions that a roll brings together but that do not touch in the picture
    line = torch.zeros(side, dtype=torch.long)
    if shift:
        line[side - width : side - shift] = 1
        line[side - shift :] = 2
    region = 3 * line[:, None] + line
    result = torch.zeros_like(grids[0])
    for row in range(0, side, width):
        for column in range(0, side, width):
            rows, columns = slice(row, row + width), slice(column, column + width)
            q1, k1, v1 = (grid[:, :, rows, columns].flatten(2, 3) for grid in grids)
            label = region[rows, columns].flatten()
            for member in label.unique():
                inside = label == member
                q2, k2, v2 = (x[:, :, inside] for x in (q1, k1, v1))
                window = result[:, :, rows, columns].flatten(2, 3)
                window[:, :, inside] = attend_reference(q2, k2, v2, None)
                result[:, :, rows, columns] = window.unflatten(2, (width, width))
    return result.roll((shift, shift), dims=(2, 3)).flatten(2, 3)


@for_each("shifted", [False, True])
@for_each(("side", "width"), [(8, 8), (16, 8), (24, 8), (4, 2), (2, 2)])
def test_windows_are_those_of_the_roll(side: int, width: int, shifted: bool) -> None:
    generator = torch.Generator().manual_seed(side)
    shape = (2, 3, side**2, 4)
    q, k, v = (torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(3))
    upstream = torch.randn(shape, generator=generator, dtype=torch.float64)

    def ours(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        windows = cut_windows(side, width, shifted=shifted, device=CPU)
        q, k, v = (x[:, :, windows.order_Q] for x in (q, k, v))
        return attend_in_windows(q, k, v, windows)[:, :, windows.back_Q]

    theirs = partial(rolled_and_masked, width=width, shifted=shifted)
    results = (value_and_gradients(each, (q, k, v), upstream) for each in (ours, theirs))
    for got, expected in zip(*results, strict=True):
        # float64 softmax over at most 64 keys
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-13)


def test_a_shifted_cut_has_whole_windows_strips_and_corners() -> None:
    windows = cut_windows(24, 8, shifted=True, device=CPU)
    assert windows.groups == ((4, 64), (8, 32), (4, 16))
    assert cut_windows(24, 8, shifted=False, device=CPU).groups == ((9, 64),)
    assert torch.equal(windows.order_Q[windows.back_Q], torch.arange(24**2))


@for_each("shifted", [False, True])
def test_a_bundle_reaches_its_own_window_only(shifted: bool) -> None:
    layer = SelfAttention(8, 2).double()
    windows = cut_windows(8, 4, shifted=shifted, device=CPU)
    x = torch.randn(1, 64, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = x.clone()
    moved[0, 0] += 1
    with torch.no_grad():
        change = (layer(moved, windows=windows) - layer(x, windows=windows)).abs().amax(dim=-1)
    reached = change.unflatten(1, (8, 8))[0] > 0
    width = 2 if shifted else 4
    expected = torch.zeros(8, 8, dtype=torch.bool)
    expected[:width, :width] = True
    assert torch.equal(reached, expected)


def test_a_cut_is_made_once_and_asks_no_device() -> None:
    """On the meta device there is nobody to ask; what inference cut, training may use."""
    with torch.inference_mode():
        meta = cut_windows(8, 4, shifted=True, device=torch.device("meta"))
        cut = cut_windows(8, 4, shifted=True, device=CPU)
    assert cut is cut_windows(8, 4, shifted=True, device=CPU)
    assert meta.groups == cut.groups == ((1, 16), (4, 8), (4, 4))
    assert meta.order_Q.shape == cut.order_Q.shape
    assert not meta.order_Q.is_inference() and not cut.back_Q.is_inference()

"""Laws of the heads: shapes, and the early 1x1 of the DPT against the published order."""

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from model.image_head import DptHead, Enlarged, Fusion, build_head
from tests.for_each import for_each
from tests.model.kit import awake, tiny_config


@for_each("head", ["linear", "dpt"])
@for_each("per_side", [1, 2, 3, 8])
def test_heads_return_eight_pixels_per_bundle(head: str, per_side: int) -> None:
    config = tiny_config(head)
    built = build_head(config)
    taps = [torch.randn(2, per_side**2, config.width) for _ in built.taps]
    assert built(taps).shape == (2, 3, 8 * per_side, 8 * per_side)


@for_each("small", [(1, 1), (1, 4), (3, 5), (16, 16)])
def test_the_way_back_of_an_enlargement_is_that_of_torch(small: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(2, 3, *small, generator=generator, dtype=torch.float64).requires_grad_()
    size = (2 * small[0] + 1, 2 * small[1])
    twin = interpolate(x, size=size, mode="bilinear", align_corners=True)
    gradient = torch.randn(twin.shape, generator=generator, dtype=torch.float64)
    assert torch.equal(twin, Enlarged.apply(x, size))
    (expected,) = torch.autograd.grad(twin, x, gradient)
    (found,) = torch.autograd.grad(Enlarged.apply(x, size), x, gradient)
    # float64 sums of tens of numbers around 1
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)


@for_each("deepest", [False, True])
def test_projecting_before_upsampling_equals_projecting_after(deepest: bool) -> None:
    fusion = Fusion(6, deepest=deepest).double()
    generator = torch.Generator().manual_seed(0)
    grid = torch.randn(2, 6, 3, 3, generator=generator, dtype=torch.float64)
    coarse = None if deepest else torch.randn(2, 6, 3, 3, generator=generator, dtype=torch.float64)

    def published_order(grid: Tensor) -> Tensor:
        if fusion.skip is not None and coarse is not None:
            grid = coarse + fusion.skip(grid)
        refined = fusion.refine(grid)
        enlarged = interpolate(refined, size=(7, 7), mode="bilinear", align_corners=True)
        return fusion.project(enlarged)

    with torch.no_grad():
        # float64 sums of six channels
        torch.testing.assert_close(
            fusion(coarse, grid, (7, 7)), published_order(grid), rtol=0, atol=1e-14
        )


def test_the_dpt_lets_a_bundle_reach_its_neighbours_and_the_linear_head_does_not() -> None:
    for head, reaches in (("linear", False), ("dpt", True)):
        config = tiny_config(head)
        built = awake(config).decoder.head
        assert isinstance(built, DptHead) == reaches
        tokens = [torch.zeros(1, 9, config.width, dtype=torch.float64) for _ in built.taps]
        changed = [tap.clone() for tap in tokens]
        for tap in changed:
            tap[0, 0] += torch.linspace(-1, 1, config.width, dtype=torch.float64)
        with torch.no_grad():
            difference = (built(changed) - built(tokens)).abs()[0].amax(dim=0)
        assert difference[:8, :8].max() > 0
        assert bool(difference[8:16, 8:16].max() > 0) == reaches

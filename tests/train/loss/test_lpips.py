"""LPIPS against loops in NumPy on small random weights; its laws; how its weights are found."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from storage.errors import TrilightError
from storage.seeds import rng_for
from train.loss.lpips import (
    BLOCKS,
    LINEAR_FILE,
    LINEAR_URL,
    SCALE,
    SHIFT,
    VGG16_FILE,
    VGG16_URL,
    Lpips,
    load_lpips,
)

WIDTHS = (4, 5, 6, 7, 8)
RESOLUTION = 16


def small_weights() -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Weights by their published names, but with few channels."""
    rng = rng_for(0, "vgg")
    vgg16, linear, before = {}, {}, 3
    for block, (numbers, width) in enumerate(zip(BLOCKS, WIDTHS, strict=True)):
        for number in numbers:
            weight = rng.normal(0, 0.4, (width, before, 3, 3))
            vgg16[f"features.{number}.weight"] = torch.from_numpy(weight).float()
            vgg16[f"features.{number}.bias"] = torch.from_numpy(rng.normal(0, 0.1, width)).float()
            before = width
        lin = rng.uniform(0, 1, (1, width, 1, 1))
        linear[f"lin{block}.model.1.weight"] = torch.from_numpy(lin).float()
    return vgg16, linear


def convolved(x: NDArray, weight: NDArray, bias: NDArray) -> NDArray:
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    out = np.zeros((len(weight), *x.shape[1:]))
    for row, column in itertools.product(range(3), range(3)):
        window = padded[:, row : row + x.shape[1], column : column + x.shape[2]]
        out += np.einsum("oc,chw->ohw", weight[:, :, row, column], window)
    return out + bias[:, None, None]


def by_hand(a: NDArray, b: NDArray, vgg16: dict, linear: dict) -> float:
    """Zhang et al. 2018, equation 1, for one pair [3, R, R] in [0, 1]."""
    total = 0.0
    grids = [
        (2 * picture - 1 - np.array(SHIFT)[:, None, None]) / np.array(SCALE)[:, None, None]
        for picture in (a, b)
    ]
    for block, numbers in enumerate(BLOCKS):
        if block:
            grids = [
                np.maximum.reduce([g[:, i::2, j::2] for i in (0, 1) for j in (0, 1)]) for g in grids
            ]
        for number in numbers:
            weight, bias = (
                vgg16[f"features.{number}.{part}"].double().numpy() for part in ("weight", "bias")
            )
            grids = [np.maximum(convolved(grid, weight, bias), 0) for grid in grids]
        x, y = (g / np.maximum(np.sqrt((g**2).sum(0, keepdims=True)), 1e-10) for g in grids)
        lin = linear[f"lin{block}.model.1.weight"].double().numpy()[0]
        total += float((lin * (x - y) ** 2).sum(axis=0).mean())
    return total


def pictures(name: str, count: int = 2) -> Tensor:
    rng = rng_for(0, name)
    return torch.from_numpy(rng.random((count, 3, RESOLUTION, RESOLUTION))).float()


def test_it_is_the_published_formula() -> None:
    weights = small_weights()
    a, b = pictures("a"), pictures("b")
    ours = Lpips(*weights)(a, b)
    expected = [by_hand(x, y, *weights) for x, y in zip(a.numpy(), b.numpy(), strict=True)]
    # float32 against float64 through thirteen convolutions
    np.testing.assert_allclose(ours.numpy(), expected, rtol=1e-5)
    assert min(expected) > 0.01


def test_equal_pictures_are_at_no_distance_and_the_order_does_not_matter() -> None:
    lpips = Lpips(*small_weights())
    a, b = pictures("a"), pictures("b")
    assert torch.equal(lpips(a, a), torch.zeros(2))
    torch.testing.assert_close(lpips(a, b), lpips(b, a), rtol=0, atol=0)
    assert (lpips(a, b) > 0).all()


def test_the_hub_has_both_files_and_the_large_one_is_checked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checked, there = {}, dict(zip((VGG16_URL, LINEAR_URL), small_weights(), strict=True))

    def download(url: str, *, check_hash: bool, **_: Any) -> dict[str, Tensor]:
        checked[url] = check_hash
        return there[url]

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", download)
    found, (a, b) = load_lpips("hub"), (pictures("a"), pictures("b"))
    assert found is not None
    assert torch.equal(found(a, b), Lpips(*small_weights())(a, b))
    assert checked == {VGG16_URL: True, LINEAR_URL: False}


def test_its_gradient_is_that_of_its_values() -> None:
    lpips = Lpips(*small_weights()).double()
    a, b = pictures("a", 1).double().requires_grad_(), pictures("b", 1).double()
    lpips(a, b).sum().backward()
    assert a.grad is not None
    step = 1e-6 * torch.from_numpy(rng_for(0, "step").normal(size=a.shape))
    with torch.no_grad():
        change = (lpips(a + step, b) - lpips(a - step, b)).item() / 2
    # central differences; a ReLU that a step of 1e-6 crosses costs about as much
    assert change == pytest.approx((a.grad * step).sum().item(), rel=1e-4)
    assert not any(weight.requires_grad for weight in lpips.parameters())


def test_pictures_without_any_feature_have_a_finite_gradient() -> None:
    vgg16, linear = small_weights()
    vgg16 = {name: -tensor.abs() for name, tensor in vgg16.items()}
    black = torch.full((1, 3, RESOLUTION, RESOLUTION), 0.9, requires_grad=True)
    Lpips(vgg16, linear)(black, pictures("b", 1)).sum().backward()
    assert black.grad is not None and torch.isfinite(black.grad).all()


def test_small_pictures_are_refused() -> None:
    with pytest.raises(TrilightError, match="pictures of 8 pixels; expected at least 16"):
        Lpips(*small_weights())(*torch.zeros(2, 1, 3, 8, 8))


def test_weights_come_from_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRILIGHT_LPIPS", raising=False)
    assert load_lpips(None) is None
    vgg16, linear = small_weights()
    with pytest.raises(TrilightError, match=f"{VGG16_FILE} does not exist"):
        load_lpips(str(tmp_path))
    torch.save(vgg16, tmp_path / VGG16_FILE)
    torch.save(linear, tmp_path / LINEAR_FILE)
    a, b = pictures("a"), pictures("b")
    expected = Lpips(vgg16, linear)(a, b)
    found = load_lpips(str(tmp_path))
    assert found is not None and torch.equal(found(a, b), expected)
    monkeypatch.setenv("TRILIGHT_LPIPS", str(tmp_path))
    found = load_lpips(None)
    assert found is not None and torch.equal(found(a, b), expected)


class _RunsCode:
    def __reduce__(self) -> tuple:
        return print, ("this ran",)


def test_a_file_that_is_none_is_refused_and_runs_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    vgg16, linear = small_weights()
    torch.save(linear, tmp_path / LINEAR_FILE)
    for wrong, message in (
        ({"x": _RunsCode()}, "is not readable"),
        ([1, 2], "holds no state dict"),
        (linear, "no features.0.weight"),
        (vgg16 | {"features.5.weight": torch.zeros(5, 3, 3, 3)}, "features.5.weight has the shape"),
    ):
        torch.save(wrong, tmp_path / VGG16_FILE)
        with pytest.raises(TrilightError, match=message):
            load_lpips(str(tmp_path))
    assert "this ran" not in capsys.readouterr().out
    (tmp_path / VGG16_FILE).write_bytes(b"<html>")
    with pytest.raises(TrilightError, match="is not readable"):
        load_lpips(str(tmp_path))
    with pytest.raises(TrilightError, match="lin3.model.1.weight is missing"):
        Lpips(vgg16, {name: t for name, t in linear.items() if "3" not in name})

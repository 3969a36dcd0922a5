"""We are the published network: its outputs, from its weights, to float32's own floor."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from model import check_reference
from model.check_reference import (
    TOLERANCE,
    Differences,
    Reference,
    differences,
    main,
    read_reference,
)
from model.weights import read_tensors
from tests.for_each import for_each

FILES = ["base_tiny.safetensors", "swin_tiny.safetensors"]


def found_in(shared: Path, name: str) -> Path:
    path = shared / "renderformer_reference" / name
    if not path.exists():
        pytest.skip(f"{path} is missing")
    return path


@pytest.fixture(scope="module", params=FILES)
def reference(request: pytest.FixtureRequest, shared: Path) -> Path:
    return found_in(shared, request.param)


@pytest.fixture(scope="module")
def base(shared: Path) -> Path:
    return found_in(shared, FILES[0])


def changed(reference: Path, folder: Path, name: str, change: Tensor) -> str:
    """Return a copy of the file in which one tensor is another."""
    _, metadata = read_tensors(reference)
    tensors = load_file(reference)
    path = folder / "changed.safetensors"
    save_file(tensors | {name: change.to(tensors[name].dtype)}, path, metadata=metadata)
    return str(path)


def test_outputs_are_the_published_ones(
    reference: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    found: list[Differences] = []

    def kept(read: Reference) -> Differences:
        found.append(differences(read))
        return found[0]

    monkeypatch.setattr(check_reference, "differences", kept)
    assert main([str(reference)]) == 0
    # float32's own rounding of these files is 6e-8; ten real mistakes would pass at 1e-5
    assert found[0].padded < 5e-7
    assert found[0].unpadded < 5e-7
    assert TOLERANCE == 5e-7
    printed = capsys.readouterr().out
    for word in ("padded", "unpadded", "max difference", "passes"):
        assert word in printed


@for_each("place", [0, -1])
def test_a_pixel_that_differs_is_in_both_differences(base: Path, place: int) -> None:
    """In the first or the last scene: neither comparison may stop at the other's result."""
    read = read_reference(base)
    read.expected_BVRR3[(place,) * 5] += 1e-6
    found = differences(read)
    assert found.padded > TOLERANCE and found.unpadded > TOLERANCE and not found.is_accepted


def test_the_command_fails_on_nan(
    base: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    name = "param.view_transformer.out_dpt.scratch.output_conv2.2.bias"
    assert main([changed(base, tmp_path, name, torch.full((3,), torch.nan))]) == 1
    assert "FAILS" in capsys.readouterr().out


def test_what_stands_in_the_padding_does_not_matter(reference: Path, tmp_path: Path) -> None:
    tensors = load_file(reference)
    triangles = tensors["input.triangles"]
    triangles[tensors["input.valid_mask"] == 0] = torch.nan
    assert main([changed(reference, tmp_path, "input.triangles", triangles)]) == 0


@for_each("arguments", [[], ["a", "b"]])
def test_the_command_takes_one_file(arguments: list[str]) -> None:
    assert main(arguments) == 2


def test_another_file_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"input.triangles": torch.zeros(1, 1, 3, 3)}, path)
    assert main([str(path)]) == 1
    printed = capsys.readouterr().err
    assert "no input.vertex_normals, " in printed and "config" in printed

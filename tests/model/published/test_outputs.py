"""We are the published network: its outputs, from its weights, to float32's own floor."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from model.check_reference import TOLERANCE, differences, main, read_reference
from model.weights import read_tensors

FILES = ["base_tiny.safetensors", "swin_tiny.safetensors"]


@pytest.fixture(scope="module", params=FILES)
def reference(request: pytest.FixtureRequest, shared: Path) -> Path:
    path = shared / "renderformer_reference" / request.param
    if not path.exists():
        pytest.skip(f"{path} is missing")
    return path


def changed(reference: Path, folder: Path, name: str, change: Tensor) -> str:
    """Return a copy of the file in which one tensor is another."""
    _, metadata = read_tensors(reference)
    tensors = load_file(reference)
    path = folder / "changed.safetensors"
    save_file(tensors | {name: change.to(tensors[name].dtype)}, path, metadata=metadata)
    return str(path)


def test_outputs_are_the_published_ones(reference: Path) -> None:
    found = differences(read_reference(reference))
    # float32's own rounding of these files is 6e-8; ten real mistakes would pass at 1e-5
    assert found.padded < 5e-7
    assert found.unpadded < 5e-7
    assert TOLERANCE == 5e-7


def test_the_command_passes_and_prints(reference: Path, capsys: pytest.CaptureFixture) -> None:
    assert main([str(reference)]) == 0
    printed = capsys.readouterr().out
    for word in ("padded", "unpadded", "max difference", "passes"):
        assert word in printed


@pytest.mark.parametrize("place", [0, -1])
def test_the_command_fails_where_one_pixel_differs(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture, place: int
) -> None:
    """In the first or the last scene: neither comparison may stop at the other's result."""
    name = "output.log10_radiance_bvchw"
    expected = load_file(reference)[name]
    expected.view(-1)[place] += 1e-6
    path = changed(reference, tmp_path, name, expected)
    found = differences(read_reference(Path(path)))
    assert found.padded > TOLERANCE and found.unpadded > TOLERANCE
    assert main([path]) == 1
    assert "FAILS" in capsys.readouterr().out


def test_the_command_fails_on_nan(reference: Path, tmp_path: Path) -> None:
    name = "param.view_transformer.out_dpt.scratch.output_conv2.2.bias"
    assert main([changed(reference, tmp_path, name, torch.full((3,), torch.nan))]) == 1


def test_what_stands_in_the_padding_does_not_matter(reference: Path, tmp_path: Path) -> None:
    tensors = load_file(reference)
    triangles = tensors["input.triangles"]
    triangles[tensors["input.valid_mask"] == 0] = torch.nan
    assert main([changed(reference, tmp_path, "input.triangles", triangles)]) == 0


@pytest.mark.parametrize("arguments", [[], ["a", "b"]])
def test_the_command_takes_one_file(arguments: list[str]) -> None:
    assert main(arguments) == 2


def test_another_file_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"input.triangles": torch.zeros(1, 1, 3, 3)}, path)
    assert main([str(path)]) == 1
    printed = capsys.readouterr().err
    assert "no input.vertex_normals, " in printed and "config" in printed

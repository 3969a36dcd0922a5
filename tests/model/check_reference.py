"""`python -m tests.model.check_reference FILE`: compares this network with the published outputs.

Reads a file with a configuration, weights under published names, scenes, and the published code's
outputs; runs this network on all scenes, padded to the longest, and on each alone. Prints the
largest differences of the log10 output and exits with 1 above 5e-7, which is eight times
float32's rounding: a tolerance of 1e-5 would accept ten real mistakes.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import elu

from model.config import ModelConfig
from model.published import NORMAL, decode_published_config, load_published_weights
from model.renderformer import ELU_ALPHA
from model.scene_tensors import SceneTensors, batch_scenes
from model.weights import read_tensors
from storage.errors import TrilightError

TOLERANCE = 5e-7
"""Maximum absolute difference of log10 outputs."""

_PARAMETER = "param."
_INPUTS = ("triangles", "vertex_normals", "material13", "valid_mask", "c2w", "fov_deg")
_OUTPUT = "output.log10_radiance_bvchw"


@torch.no_grad()
def differences(path: Path) -> dict[str, float]:
    """Return the largest differences from the published network, and the scale of its output.

    `padded` is that of the batch of all scenes of a reference file; `unpadded` that of a scene
    alone; `std` the deviation of the expected output.

    Raises:
        TrilightError: the file lacks entries; the message names them.
    """
    tensors, metadata = read_tensors(path)
    required = [*(f"input.{name}" for name in _INPUTS), _OUTPUT]
    missing = [name for name in required if name not in tensors]
    missing += [name for name in ("config", "resolution") if name not in metadata]
    if missing:
        raise TrilightError(
            f"{path}: no {', '.join(missing)}; expected a file of reference outputs."
        )
    model = load_published_weights(*published_network(tensors, metadata))
    expected_BVRR3 = tensors[_OUTPUT].float().movedim(2, -1)

    def difference(scenes: Sequence[SceneTensors], expected: Tensor) -> Tensor:
        got = elu(model(batch_scenes(scenes), int(metadata["resolution"])), alpha=ELU_ALPHA)
        return (got - expected).abs().max()

    scenes = _scenes(tensors)
    alone = [difference([scene], expected_BVRR3[[row]]) for row, scene in enumerate(scenes)]
    return {
        "padded": difference(scenes, expected_BVRR3).item(),
        "unpadded": torch.stack(alone).max().item(),
        "std": expected_BVRR3.std().item(),
    }


def published_network(
    tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> tuple[dict[str, Tensor], tuple[ModelConfig, int]]:
    """Return the published weights of a file, and their configuration and texture patch."""
    stored = {name: tensor for name, tensor in tensors.items() if name.startswith(_PARAMETER)}
    weights = {name.removeprefix(_PARAMETER): tensor for name, tensor in stored.items()}
    return weights, decode_published_config(json.loads(metadata["config"]))


def _scenes(tensors: Mapping[str, Tensor]) -> list[SceneTensors]:
    """Return the scenes without padding, with encoded emission and no tangent normal."""
    triangles, normals, material, mask, c2w, fov = (
        tensors[f"input.{name}"].float() for name in _INPUTS
    )
    ten = torch.cat(
        [material[..., : NORMAL.start], torch.log10(1 + material[..., NORMAL.stop :])], dim=-1
    )
    return [
        SceneTensors(
            triangles_T33=triangles[row, exists_T],
            normals_T33=normals[row, exists_T],
            material_TM=ten[row, exists_T],
            c2w_V44=c2w[row],
            fov_deg_V=fov[row, :, 0],
        )
        for row, exists_T in enumerate(mask.bool())
    ]


def main(arguments: list[str]) -> int:
    """Run the comparison on one file; returns the exit status."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m tests.model.check_reference FILE.safetensors\n")
        return 2
    try:
        largest = differences(Path(arguments[0]))
    except TrilightError as mistake:
        sys.stderr.write(f"check_reference: {mistake}\n")
        return 1
    std = largest.pop("std")
    for name, value in largest.items():
        text = f"max difference {value:.3g} ({value / std:.3g} of the output's std)"
        sys.stdout.write(f"{name:<9} {text}\n")
    passes = all(value <= TOLERANCE for value in largest.values())  # NaN is not
    sys.stdout.write(f"{'passes' if passes else 'FAILS'}: expected at most {TOLERANCE:g}\n")
    return 0 if passes else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

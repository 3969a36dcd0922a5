"""`python -m model.check_reference FILE`: compares this network with the published one's outputs.

Reads a file with a configuration, weights under published names, scenes, and the published code's
outputs; runs this network on it, padded as in the file and each scene alone without padding. Prints
the largest differences of the log10 output and exits with 1 above 5e-7, which is eight times
float32's rounding: a tolerance of 1e-5 would accept ten real mistakes.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import elu

from model.published import NORMAL, decode_published_config, load_published_weights
from model.renderformer import ELU_ALPHA, RenderFormer
from model.scene_tensors import SceneBatch
from model.weights import read_tensors
from storage.errors import TrilightError

TOLERANCE = 5e-7
"""Maximum absolute difference of log10 outputs."""

_PARAMETER = "param."
_INPUTS = ("triangles", "vertex_normals", "material13", "valid_mask", "c2w", "fov_deg")
_OUTPUT = "output.log10_radiance_bvchw"


@dataclass(frozen=True, kw_only=True, eq=False)
class Reference:
    """Network, scenes and expected pictures of one file."""

    model: RenderFormer
    """Network in float32 with the file's weights."""
    batch: SceneBatch
    """Scenes, padded as in the file."""
    resolution: int
    """Width of the pictures in pixels."""
    expected_BVRR3: Tensor
    """Output of the published network, after its ELU."""


@dataclass(frozen=True, kw_only=True)
class Differences:
    """Largest absolute differences from the reference."""

    padded: float
    """Difference of the whole batch, padding included."""
    unpadded: float
    """Largest difference of a scene alone, on the triangles that exist."""
    output_std: float
    """Standard deviation of the expected output, the scale of a difference."""

    @property
    def is_accepted(self) -> bool:
        """True if both are within TOLERANCE; NaN is not."""
        return self.padded <= TOLERANCE and self.unpadded <= TOLERANCE


def read_reference(path: Path) -> Reference:
    """Return the content of a reference file.

    Raises:
        TrilightError: the file lacks entries; the message names them.
    """
    tensors, metadata = read_tensors(path)
    inputs = [f"input.{name}" for name in _INPUTS]
    missing = [name for name in (*inputs, _OUTPUT) if name not in tensors]
    missing += [name for name in ("config", "resolution") if name not in metadata]
    if missing:
        raise TrilightError(
            f"{path}: no {', '.join(missing)}; expected a file of reference outputs."
        )
    parameters = {
        name.removeprefix(_PARAMETER): tensor
        for name, tensor in tensors.items()
        if name.startswith(_PARAMETER)
    }
    return Reference(
        model=load_published_weights(
            parameters, decode_published_config(json.loads(metadata["config"]))
        ),
        batch=_batch(*(tensors[name] for name in inputs)),
        resolution=int(metadata["resolution"]),
        expected_BVRR3=tensors[_OUTPUT].float().movedim(2, -1),
    )


def differences(reference: Reference) -> Differences:
    """Return the largest differences between this network and the published one."""
    batch = reference.batch
    expected = reference.expected_BVRR3
    alone = [
        _difference(reference, _scene_alone(batch, scene), expected[[scene]])
        for scene in range(len(expected))
    ]
    return Differences(
        padded=_difference(reference, batch, expected).item(),
        unpadded=torch.stack(alone).max().item(),
        output_std=expected.std().item(),
    )


def _batch(
    triangles: Tensor, normals: Tensor, material13: Tensor, mask: Tensor, c2w: Tensor, fov: Tensor
) -> SceneBatch:
    """Return the batch with zero padding, encoded emission and no tangent normal."""
    exists = mask.bool()
    material = material13.float()
    ten = torch.cat(
        [material[..., : NORMAL.start], torch.log10(1 + material[..., NORMAL.stop :])], dim=-1
    )
    return SceneBatch(
        triangles_BT33=triangles.float().where(exists[..., None, None], 0),
        normals_BT33=normals.float().where(exists[..., None, None], 0),
        material_BTM=ten.where(exists[..., None], 0),
        c2w_BV44=c2w.float(),
        fov_deg_BV=fov.float()[..., 0],
        is_triangle_BT=exists,
    )


def _scene_alone(batch: SceneBatch, scene: int) -> SceneBatch:
    assert batch.is_triangle_BT is not None
    exists = batch.is_triangle_BT[scene]
    return SceneBatch(
        triangles_BT33=batch.triangles_BT33[[scene]][:, exists],
        normals_BT33=batch.normals_BT33[[scene]][:, exists],
        material_BTM=batch.material_BTM[[scene]][:, exists],
        c2w_BV44=batch.c2w_BV44[[scene]],
        fov_deg_BV=batch.fov_deg_BV[[scene]],
        is_triangle_BT=None,
    )


@torch.no_grad()
def _difference(reference: Reference, batch: SceneBatch, expected_BVRR3: Tensor) -> Tensor:
    got = elu(reference.model(batch, reference.resolution), alpha=ELU_ALPHA)
    return (got - expected_BVRR3).abs().max()


def main(arguments: list[str]) -> int:
    """Run the comparison on one file; returns the exit status."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m model.check_reference FILE.safetensors\n")
        return 2
    try:
        result = differences(read_reference(Path(arguments[0])))
    except TrilightError as mistake:
        sys.stderr.write(f"check_reference: {mistake}\n")
        return 1
    for name, value in (("padded", result.padded), ("unpadded", result.unpadded)):
        share = value / result.output_std
        sys.stdout.write(
            f"{name:<9} max difference {value:.3g} ({share:.3g} of the output's std)\n"
        )
    sys.stdout.write(
        f"{'passes' if result.is_accepted else 'FAILS'}: expected at most {TOLERANCE:g}\n"
    )
    return 0 if result.is_accepted else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Error of a precision, layer by layer, against the same network in float64.

Shows where the error arises, and how near a layer's activations come to the largest number of a
type: float16 ends at 65504.
"""

import copy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from model.config import ModelConfig
from model.precision import set_precision
from model.renderformer import RenderFormer
from model.scene_tensors import SceneBatch, SceneTensors, batch_scenes, converted
from storage.records.material import material_columns, material_width

PROBE_TRIANGLES, PROBE_RESOLUTION = 256, 64
"""Size of the random scene that errors are measured on."""


@dataclass(frozen=True, kw_only=True)
class LayerError:
    """One layer's output."""

    layer: str
    """Its name in the network."""
    peak: float
    """Largest absolute value in float64."""
    relative_error: float
    """Root mean square of the error, as a share of that of the output itself."""
    max_error: float
    """Largest absolute error."""


def layer_errors(
    model: RenderFormer, batch: SceneBatch, resolution: int, precision: str
) -> list[LayerError]:
    """Return the errors of a float32 network's layers at a precision, in the order of computation.

    Each includes what the layers before it have done. The network and the batch stay unchanged.

    Raises:
        TrilightError: as `set_precision`.
    """
    rounded = set_precision(copy.deepcopy(model), precision)
    precise = copy.deepcopy(model).double()
    as_float64 = converted(batch, lambda x: x.double() if x.is_floating_point() else x)
    expected = _outputs(precise, as_float64, resolution)
    got = _outputs(rounded, batch, resolution)
    return [_compare(name, got[name], twin) for name, twin in expected.items()]


def random_network(config: ModelConfig) -> RenderFormer:
    """Return a network with fresh weights, and a last layer that is not yet black."""
    generator = torch.Generator().manual_seed(0)
    model = RenderFormer(config)
    model.initialise(generator)
    nn.init.xavier_uniform_(model.decoder.head.last.weight, generator=generator)
    return model.eval()


def probe_batch() -> SceneBatch:
    """Return a random scene in the nominal shell, always the same, and one camera before it."""
    generator = torch.Generator().manual_seed(0)
    centre = torch.rand(PROBE_TRIANGLES, 1, 3, generator=generator) - 0.5
    normals = torch.randn(PROBE_TRIANGLES, 3, 3, generator=generator)
    c2w_V44 = torch.eye(4)[None].clone()
    c2w_V44[0, 2, 3] = 2.0
    columns = tuple(column.name for column in material_columns())
    scene = SceneTensors(
        triangles_T33=centre + 0.1 * torch.randn(PROBE_TRIANGLES, 3, 3, generator=generator),
        normals_T33=normals / normals.norm(dim=-1, keepdim=True),
        material_TM=torch.rand(PROBE_TRIANGLES, material_width(), generator=generator),
        columns=columns,
        c2w_V44=c2w_V44,
        fov_deg_V=torch.tensor([40.0]),
    )
    return batch_scenes([scene])


@torch.no_grad()
def _outputs(model: RenderFormer, batch: SceneBatch, resolution: int) -> dict[str, Tensor]:
    """Return the output of each layer, in the order in which they run."""
    outputs: dict[str, Tensor] = {}

    def keep(name: str) -> object:
        def hook(module: nn.Module, inputs: object, output: Any) -> None:
            # layers of the encoder leave their last addition to the next one
            whole = output[0] + output[1] if isinstance(output, tuple) else output
            outputs[name] = whole.double()

        return hook

    layers: list[tuple[str, nn.Module]] = []
    if model.encoder is not None:
        layers.append(("encoder.tokens", model.encoder.tokens))
        layers += [(f"encoder.layers.{i}", layer) for i, layer in enumerate(model.encoder.layers)]
    layers += [(f"decoder.layers.{i}", layer) for i, layer in enumerate(model.decoder.layers)]
    layers += [("decoder.head", model.decoder.head)]
    handles = [layer.register_forward_hook(keep(name)) for name, layer in layers]  # type: ignore[arg-type]
    try:
        model(batch, resolution)
    finally:
        for handle in handles:
            handle.remove()
    return outputs


def _compare(layer: str, got: Tensor, expected: Tensor) -> LayerError:
    error = got - expected
    return LayerError(
        layer=layer,
        peak=expected.abs().max().item(),
        relative_error=(error.square().mean() / expected.square().mean()).sqrt().item(),
        max_error=error.abs().max().item(),
    )

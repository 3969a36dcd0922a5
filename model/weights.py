"""Weights as one safetensors file that carries its own configuration; no pickle anywhere."""

import dataclasses
import json

import torch
from safetensors.torch import save
from torch import Tensor

from model.config import ModelConfig
from model.renderformer import RenderFormer
from model.trained_range import TrainedRange
from storage.errors import TrilightError
from storage.safe_read import read_safetensors

CONFIG_KEY = "trilight_model"
"""Metadata entry that holds the configuration as JSON."""


def encode_weights(model: RenderFormer, trained: TrainedRange | None = None) -> bytes:
    """Return the file of a network; equal networks give equal bytes.

    Args:
        model: the network.
        trained: what it was trained on, where that is known.
    """
    tensors = {name: tensor.contiguous() for name, tensor in model.state_dict().items()}
    known = {} if trained is None else trained.as_metadata()
    return save(tensors, metadata={CONFIG_KEY: encode_config(model.config), **known})


def decode_weights(data: bytes) -> RenderFormer:
    """Return the network of a file, in evaluation mode on the CPU.

    Raises:
        TrilightError: not such a file, or its tensors are not those of its configuration; the
            names are listed. Published checkpoints have other names and are not read here.
    """
    arrays, metadata = read_safetensors(data)
    if CONFIG_KEY not in metadata:
        raise TrilightError(
            f"weights: the file has no {CONFIG_KEY} entry; expected a model.safetensors as "
            "`trilight train` writes it."
        )
    model = RenderFormer(decode_config(metadata[CONFIG_KEY]))
    load_tensors(model, {name: torch.from_numpy(array) for name, array in arrays.items()})
    return model.eval()


def load_tensors(model: RenderFormer, tensors: dict[str, Tensor]) -> None:
    """Put tensors into a network of the same configuration.

    Raises:
        TrilightError: a name is missing, unknown, or has another shape; the first few are listed.
    """
    expected = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    got = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    wrong = [
        f"{name} is {got.get(name, 'missing')}, expected {expected.get(name, 'no such tensor')}"
        for name in sorted(expected.keys() | got.keys())
        if expected.get(name) != got.get(name)
    ]
    if wrong:
        more = f" and {len(wrong) - 5} more" if len(wrong) > 5 else ""
        raise TrilightError(f"weights: {'; '.join(wrong[:5])}{more}.")
    model.load_state_dict(tensors)


def encode_config(config: ModelConfig) -> str:
    """Return the JSON of a configuration."""
    return json.dumps(dataclasses.asdict(config), sort_keys=True)


def decode_config(text: str) -> ModelConfig:
    """Return the configuration of its JSON; raises TrilightError where it is none."""
    try:
        fields = json.loads(text)
        lists = {name: tuple(value) for name, value in fields.items() if isinstance(value, list)}
        return ModelConfig(**fields | lists)
    except (TypeError, ValueError, AttributeError) as error:
        raise TrilightError(f"model config: not readable ({error}).") from error

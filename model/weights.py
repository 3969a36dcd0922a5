"""Safetensors files of networks: weights, configuration and trained range, without pickle."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from model.config import ModelConfig
from model.renderformer import RenderFormer
from storage.errors import TrilightError, prefix_errors, without_removed
from storage.records.safe_read import (
    MAX_HEADER_BYTES,
    name_unreadable,
    open_plain,
    safetensors_header,
)
from storage.settings.described import from_record
from storage.typed_json import read_json

RANGE_KEY = "trilight_trained_range"
"""Metadata entry of a weights file with its trained range as JSON."""

MAX_LIGHTS = 8
"""Maximum number of emitting triangles of a training scene, in the published data and in ours."""


@dataclass(frozen=True, kw_only=True)
class TrainedRange:
    """Largest scene and picture width of the training data; None if unknown.

    Renderers warn about a scene outside this range; they do not refuse it.
    """

    max_triangles: int | None = None
    """Maximum number of triangles of a scene."""
    resolution: int | None = None
    """Width of the pictures in pixels."""


PUBLISHED_RANGE = TrainedRange(max_triangles=4096, resolution=512)
"""Range of the published checkpoints: their second stage (Zeng et al. 2025)."""


CONFIG_KEY = "trilight_model"
"""Metadata entry that holds the configuration as JSON."""


def encode_weights(model: RenderFormer, trained: TrainedRange | None = None) -> bytes:
    """Return the bytes of a network's file; equal networks give equal bytes.

    Args:
        trained: range of its training data, if known.
    """
    tensors = {name: tensor.contiguous() for name, tensor in model.state_dict().items()}
    known = {} if trained is None else {RANGE_KEY: json.dumps(asdict(trained), sort_keys=True)}
    return _sort_metadata(
        save(tensors, metadata={CONFIG_KEY: encode_config(model.config), **known})
    )


def network_digest(model: RenderFormer) -> str:
    """Return the sha256 of configuration and weights, independent of the file format."""
    digest = hashlib.sha256(encode_config(model.config).encode())
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _sort_metadata(data: bytes) -> bytes:
    """Sort the metadata of a safetensors file, whose writer orders it randomly per process."""
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    assert len(text) <= end - 8  # as compact as it was written, and padded with spaces alike
    return data[:8] + text.ljust(end - 8) + data[end:]


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return tensors and metadata of a safetensors file; the size of its header is limited.

    Raises:
        TrilightError: the file cannot be read, is damaged, or is pickled code, which is never run.
    """
    metadata = read_metadata(path)
    try:
        with name_unreadable(path):
            return load_file(path), metadata
    except (SafetensorError, KeyError) as error:
        raise TrilightError(f"{path}: unreadable ({error}).") from error


def read_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of a safetensors file without its tensors; raises as `read_tensors`."""
    with name_unreadable(path), open_plain(path) as file:
        start = file.read(8 + MAX_HEADER_BYTES)
    if start[:2] in (b"PK", b"\x80\x02", b"\x80\x04"):
        raise TrilightError(
            f"{path}: pickled code, which a checkpoint could run; expected safetensors. "
            "Convert it with the tool that wrote it."
        )
    metadata: dict[str, str] = safetensors_header(start, name=str(path)).get("__metadata__") or {}
    return metadata


def network_of(config: ModelConfig, tensors: Mapping[str, Tensor]) -> RenderFormer:
    """Return a network that shares these tensors, in evaluation mode.

    No weight is initialized or copied, which saves seconds and gigabytes at 483 M parameters.

    Raises:
        TrilightError: as `require_tensors`.
    """
    with torch.device("meta"):
        model = RenderFormer(config)
    require_tensors(tensors, model.state_dict())
    model.load_state_dict(dict(tensors), assign=True)
    model.decoder.rotary.reset()
    # a head of convolutions reads tokens channels last, and is fastest with weights in that format
    model.decoder.head.to(memory_format=torch.channels_last)
    return model.eval()


def load_tensors(model: RenderFormer, tensors: Mapping[str, Tensor]) -> None:
    """Copy tensors into a network of the same configuration; raises as `require_tensors`."""
    require_tensors(tensors, model.state_dict())
    model.load_state_dict(dict(tensors))


def require_tensors(got: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Compare names and shapes of tensors.

    Raises:
        TrilightError: a name is missing or unknown, or a shape differs; the first few are listed.
    """
    shapes = {name: tuple(tensor.shape) for name, tensor in got.items()}
    expected_shapes = {name: tuple(tensor.shape) for name, tensor in expected.items()}
    wrong = [
        f"{name} is {shapes.get(name, 'missing')}, "
        f"expected {expected_shapes.get(name, 'no such tensor')}"
        for name in sorted(shapes.keys() | expected_shapes.keys())
        if shapes.get(name) != expected_shapes.get(name)
    ]
    if wrong:
        more = f" and {len(wrong) - 5} more" if len(wrong) > 5 else ""
        raise TrilightError(f"weights: {'; '.join(wrong[:5])}{more}.")


def encode_config(config: ModelConfig) -> str:
    """Return the JSON of a configuration.

    Settings after the first ones are omitted at their defaults, so that bytes and digests of older
    networks stay unchanged.
    """
    fields = dataclasses.asdict(config)
    later = list(fields).index("view_stage")
    for each in dataclasses.fields(config)[later:]:
        if fields[each.name] == each.default:
            del fields[each.name]
    return json.dumps(fields, sort_keys=True)


def decode_config(text: str, source: str = "network") -> ModelConfig:
    """Return the configuration from its JSON; errors begin with `source`.

    Raises:
        TrilightError: the JSON is invalid, or uses removed settings.
    """
    fields = read_json(text, dict[str, Any], f"{source}: its model configuration")
    known = without_removed(fields, ModelConfig.REMOVED, f"{source}: model")
    with prefix_errors(f"{source}: model"):
        return from_record(ModelConfig, known)

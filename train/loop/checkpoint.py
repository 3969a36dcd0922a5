"""Checkpoints: one safetensors file with all that changes while a run goes on.

It appears by rename, so a kill while saving leaves the previous one whole. It also names the
settings and the data, because going on with others would be neither the old run nor a new one; and
it holds the sha256 of itself, because safetensors would not notice a weight that a disk changed.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor

from model.renderformer import RenderFormer
from model.weights import decode_config, encode_config, load_tensors
from storage.atomic import atomic_writer
from storage.errors import TrilightError
from storage.extensions import recorded, require_same_extensions
from storage.safe_read import read_safetensors
from storage.settings import from_record, settings_record
from train.data.unusable import Unusable
from train.loop.state import TrainState, new_state
from train.settings import TrainSettings

HEADER_KEY = "trilight_checkpoint"
"""Metadata entry with counters, damage met, settings, digest of the data, number of processes."""

UNSEALED = "0" * 64
"""Stands where the sha256 will, while it is taken. Checkpoints from before it existed have none."""


def save_checkpoint(
    path: Path, state: TrainState, settings: TrainSettings, *, data_digest: str, world_size: int
) -> None:
    """Write the checkpoint; raises TrilightError where the folder is full or cannot be written."""
    tensors = state.updater.memories()
    for name, weight in state.model.named_parameters():
        tensors[f"model/{name}"] = weight.detach()
    if state.mean_model is not None:
        for name, weight in state.mean_model.named_parameters():
            tensors[f"mean/{name}"] = weight
    header = {
        "step": state.step,
        "skipped_steps": state.skipped_steps,
        "unusable": dict(state.unusable.met),
        "settings": settings_record(settings),
        "model": encode_config(settings.model),
        "data_digest": data_digest,
        "world_size": world_size,
        **({"extensions": found} if (found := recorded("weights")) else {}),
        "sha256": UNSEALED,
    }
    contiguous = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    data = save(contiguous, metadata={HEADER_KEY: json.dumps(header)})
    before, after = _around(data, UNSEALED)
    with atomic_writer(path) as stream:
        for part in (before, _seal(before, after).encode(), after):
            stream.write(part)


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """A checkpoint as it was read."""

    header: Mapping[str, Any]
    """Step, settings, digest of the data, number of processes."""
    arrays: Mapping[str, NDArray]
    """Tensors by part and name."""

    def network(self) -> RenderFormer:
        """Return the network that was judged at that step: the running mean where there is one."""
        model = RenderFormer(decode_config(self.header["model"]))
        load_tensors(model, _part(self.arrays, "mean") or _part(self.arrays, "model"))
        return model.eval()


def is_checkpoint(metadata: Mapping[str, str]) -> bool:
    """Return whether a safetensors file with these entries is a checkpoint of a run."""
    return HEADER_KEY in metadata


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint; raises TrilightError, with its path, where it is damaged or none."""
    try:
        data = path.read_bytes()
        arrays, metadata = read_safetensors(data)
        if not is_checkpoint(metadata):
            raise TrilightError("it is none of a run; expected one that train wrote")
        header = json.loads(metadata[HEADER_KEY])
        if "sha256" in header and header["sha256"] != _seal(*_around(data, header["sha256"])):
            raise TrilightError("its bytes are not those that were written")
    except (OSError, ValueError, TypeError, TrilightError) as error:
        raise TrilightError(
            f"checkpoint {path} is not readable: {str(error).rstrip('.')}."
        ) from error
    return Checkpoint(header=header, arrays=arrays)


def _around(data: bytes, sha256: str) -> tuple[memoryview, memoryview]:
    """Return what stands before and after the place of the sha256, which is in the header."""
    start = data.index(sha256.encode())
    view = memoryview(data)
    return view[:start], view[start + len(UNSEALED) :]


def _seal(before: memoryview, after: memoryview) -> str:
    digest = hashlib.sha256(before)
    digest.update(after)
    return digest.hexdigest()


def resumed_state(
    checkpoint: Checkpoint,
    settings: TrainSettings,
    data_digest: str,
    device: torch.device | None = None,
) -> TrainState:
    """Return the state of a run, ready for its next step.

    Raises:
        TrilightError: the checkpoint belongs to other settings or other data; the first field that
            differs is named.
    """
    header = checkpoint.header
    require_same_extensions("resume: the run", header.get("extensions", {}), recorded("weights"))
    begun = from_record(TrainSettings, header["settings"])  # a field that came later is at default
    _require_same("settings", settings_record(begun), settings_record(settings))
    _require_same("data", {"digest": header["data_digest"]}, {"digest": data_digest})
    state = new_state(settings, device)
    state.step, state.skipped_steps = header["step"], header["skipped_steps"]
    state.unusable = Unusable(settings.most_unusable, header["unusable"])
    load_tensors(state.model, _part(checkpoint.arrays, "model"))
    if state.mean_model is not None:
        load_tensors(state.mean_model, _part(checkpoint.arrays, "mean"))
    if updates := state.step - state.skipped_steps:
        tensors = {name: torch.from_numpy(array) for name, array in checkpoint.arrays.items()}
        state.updater.remember(tensors, updates)
    return state


def _part(arrays: Mapping[str, NDArray], prefix: str) -> dict[str, Tensor]:
    start = f"{prefix}/"
    return {
        name.removeprefix(start): torch.from_numpy(array)
        for name, array in arrays.items()
        if name.startswith(start)
    }


def _require_same(place: str, saved: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Raise for the first field that differs between a checkpoint and what is asked for now."""
    for name in sorted(saved.keys() | wanted.keys()):
        before, now = saved.get(name), wanted.get(name)
        if isinstance(before, dict) and isinstance(now, dict):
            _require_same(f"{place}.{name}", before, now)
        elif before != now:
            raise TrilightError(
                f"resume: {place}.{name} is {now}, but the checkpoint was made with {before}. "
                "Resume with the same, or start another run in another folder."
            )

"""Checkpoint files of training: their names, their sealed header, and the network in them.

`train.loop.checkpoints` writes them and restores the whole state of a run. A checkpoint holds its
own sha256, because safetensors does not detect a weight that a disk changed.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.renderformer import RenderFormer
from model.weights import decode_config, load_tensors, read_metadata
from storage.digests import seal_of
from storage.errors import TrilightError
from storage.records.safe_read import read_plain, read_safetensors

FOLDER_NAME = "checkpoints"
"""Name of the folder of the checkpoints in the folder of a run."""

PREFIX = "step-"
SUFFIX = ".safetensors"
"""Suffix of the file names, after the number of the step."""

HEADER_KEY = "trilight_checkpoint"
"""Metadata entry with counters, damaged samples, settings, digest of the data, the mixture, the
history, and the execution: number of processes and threads, precision of Muon's products."""

_SHA256 = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """Header and tensors of a checkpoint file."""

    header: Mapping[str, Any]
    """Step, settings, digest of the data, history, number of processes."""
    arrays: Mapping[str, NDArray]
    """Tensors by part and name."""

    def network(self) -> RenderFormer:
        """Return the network that was evaluated at that step: the EMA if there is one."""
        model = RenderFormer(decode_config(self.header["model"]))
        load_tensors(model, self.tensors_under("mean") or self.tensors_under("model"))
        return model.eval()

    def tensors_under(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors of a part, by their names in it."""
        start = f"{prefix}/"
        return {
            name.removeprefix(start): torch.from_numpy(array)
            for name, array in self.arrays.items()
            if name.startswith(start)
        }


def saved_steps(folder: Path) -> list[int]:
    """Return the steps of the saved checkpoints, oldest first."""
    names = [path.name for path in folder.glob(f"{PREFIX}*{SUFFIX}")]
    digits = [name.removeprefix(PREFIX).removesuffix(SUFFIX) for name in names]
    return sorted(int(text) for text in digits if text.isdecimal())


def path_of_step(folder: Path, step: int) -> Path:
    """Return the path of the checkpoint of a step."""
    return folder / f"{PREFIX}{step:09d}{SUFFIX}"


def find_checkpoint(path: Path) -> Path | None:
    """Return the path of a checkpoint, or of the newest one in the folder of a run; else None."""
    if path.is_dir():
        steps = saved_steps(path / FOLDER_NAME)
        if not steps:
            return None
        path = path_of_step(path / FOLDER_NAME, steps[-1])
    if path.suffix != SUFFIX or not path.is_file():
        return None
    return path if HEADER_KEY in read_metadata(path) else None


def read_header(path: Path) -> dict[str, Any]:
    """Return the header of a checkpoint without its tensors, unverified."""
    return dict(json.loads(read_metadata(path)[HEADER_KEY]))


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint and verify its bytes and weights.

    Raises:
        TrilightError: no checkpoint, other bytes than were written, or weights that are no finite
            float32 numbers; the message has the path.
    """
    try:
        data = read_plain(path)
        arrays, metadata = read_safetensors(data)
        if HEADER_KEY not in metadata:
            raise TrilightError("it belongs to no run; expected one that `trilight train` wrote")
        header = json.loads(metadata[HEADER_KEY])
        if not isinstance(header, dict) or not isinstance(header.get("model"), str):
            raise TrilightError("its header has no configuration of a network")
        seal = header.get("sha256")  # old checkpoints have none
        is_seal = isinstance(seal, str) and _SHA256.fullmatch(seal)
        if seal and not (is_seal and seal_of(data, seal) == seal):
            raise TrilightError("its bytes are not those that were written")
        for name, array in arrays.items():
            is_weight = name.startswith(("model/", "mean/"))
            if is_weight and not (array.dtype == np.float32 and np.isfinite(array).all()):
                raise TrilightError(f"{name} is {array.dtype}; expected finite float32 numbers")
    except (OSError, ValueError, RecursionError) as error:
        raise unreadable_error(path, error) from error
    return Checkpoint(header=header, arrays=arrays)


def unreadable_error(path: Path, error: Exception) -> TrilightError:
    """Return the error of a checkpoint that cannot be read."""
    return TrilightError(f"checkpoint {path} is not readable: {str(error).rstrip('.')}.")

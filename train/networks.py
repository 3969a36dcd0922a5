"""What a person may name where a trained network is wanted."""

import json
from pathlib import Path

from model.checkpoints import checkpoint_path, open_checkpoint
from model.renderformer import RenderFormer
from model.trained_range import trained_range
from storage.errors import TrilightError
from storage.safe_read import MAX_HEADER_BYTES, safetensors_header
from train.folder import RunFolder
from train.loop.checkpoint import is_checkpoint, read_checkpoint
from train.loop.checkpoints import checkpoint_path as path_of_step
from train.loop.checkpoints import saved_steps


def open_network(place: str | Path) -> RenderFormer:
    """Return a network on the CPU, in evaluation mode.

    Args:
        place: the folder of a run (its finished network, or that of its newest checkpoint), a
            checkpoint of a run, or what model.checkpoints.open_checkpoint opens.

    Raises:
        TrilightError: there is none, or it is damaged.
    """
    path = _run_file(Path(place))
    if path.suffix == ".safetensors" and path.is_file() and is_checkpoint(_metadata(path)):
        return read_checkpoint(path).network()
    return open_checkpoint(str(path))


def trained_resolution(place: str | Path) -> int | None:
    """Return the pixels across that a network was trained at, where what is named tells."""
    path = Path(place)
    if path.is_dir() and RunFolder(path).settings.is_file():
        record = json.loads(RunFolder(path).settings.read_text())
        return int(record["settings"]["resolution"])
    path = checkpoint_path(str(place))
    if path.is_file():
        metadata = _metadata(path)
        if is_checkpoint(metadata):
            return int(read_checkpoint(path).header["settings"]["resolution"])
        known = trained_range(metadata)
        return known.resolution if known else None
    return None


def _run_file(path: Path) -> Path:
    """Return the finished weights or the newest checkpoint of a run's folder; else the path."""
    folder = RunFolder(path)
    if path.is_dir() and not folder.weights.is_file():
        if steps := saved_steps(folder.checkpoints):
            return path_of_step(folder.checkpoints, steps[-1])
    return path


def _metadata(path: Path) -> dict[str, str]:
    """Return what the header of a safetensors file says beside its tensors."""
    with path.open("rb") as file:
        start = file.read(8 + MAX_HEADER_BYTES)
    try:
        found: dict[str, str] = safetensors_header(start).get("__metadata__", {})
    except TrilightError as error:
        raise TrilightError(f"{path}: {error}") from error
    return found

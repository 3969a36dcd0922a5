"""Networks of runs, for `model.open`: a folder of a run, or one of its checkpoints."""

from pathlib import Path

from model.open import FoundNetwork
from model.trained_range import TrainedRange
from model.weights import read_metadata
from train.folder import RunFolder
from train.loop.checkpoints import is_checkpoint, path_of_step, read_checkpoint, saved_steps


def network_of_run(path: Path) -> FoundNetwork | None:
    """Return the network of a run's checkpoint, or of its folder while it is not finished.

    A checkpoint is read at once, since its header is vouched for by the digest of the whole. The
    finished network of a run is a file of weights, which `model.open` reads: None.

    Args:
        path: a file or a folder, of whatever kind.

    Raises:
        TrilightError: the checkpoint is damaged.
    """
    if path.is_dir():
        folder = RunFolder(path)
        steps = saved_steps(folder.checkpoints)
        if folder.weights.is_file() or not steps:
            return None
        path = path_of_step(folder.checkpoints, steps[-1])
    if path.suffix != ".safetensors" or not path.is_file():
        return None
    if not is_checkpoint(read_metadata(path)):
        return None
    checkpoint = read_checkpoint(path)
    trained = TrainedRange(resolution=int(checkpoint.header["settings"]["resolution"]))
    return FoundNetwork(path=path, trained=trained, open=checkpoint.network)

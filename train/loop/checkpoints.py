"""Checkpoints of a run: one safetensors file each, with the whole mutable state.

A checkpoint appears by rename, so that a kill while saving leaves the previous one intact. It also
holds the settings, the digest of the data and the decisions about them (train.resume), so that a
resume with others is detected; and its own sha256, because safetensors does not detect a weight
that a disk changed.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor

from model.open import NetworkFile
from model.renderformer import RenderFormer
from model.weights import TrainedRange, decode_config, encode_config, load_tensors, read_metadata
from storage.atomic import atomic_writer, remove_leftovers
from storage.digests import seal_of
from storage.errors import TrilightError
from storage.extensions import extension_digests, require_same_extensions
from storage.records.safe_read import read_plain, read_safetensors
from storage.settings.described import from_record
from storage.settings.ranges import Within
from storage.typed_json import FINITE, Sha256, read_json
from train.data.mixture import RECORD, Mixture
from train.folder import RunFolder
from train.loop.distributed import DistributedContext
from train.loop.schedule import decay_start_step
from train.loop.state import TrainState, new_state
from train.loop.step import StepReport
from train.resume import Event, ResumePlan, event_records
from train.settings import Precision, TrainSettings
from train.stored_settings import known_settings, stored_settings

PREFIX = "step-"
SUFFIX = ".safetensors"
"""Suffix of the file names, after the number of the step."""

HEADER_KEY = "trilight_checkpoint"
"""Metadata entry with counters, damaged samples, settings, digest of the data, the mixture, the
history, and the execution: number of processes and threads, precision of Muon's products."""

UNSEALED = "0" * 64
"""Placeholder of the sha256 while it is computed. Old checkpoints have no sha256."""


Steps = Annotated[int, Within(0, 10**12, unit="steps")]


@dataclass(frozen=True, kw_only=True)
class _Header:
    """Header of a checkpoint, as `_encode_checkpoint` writes it; old ones lack the defaults."""

    step: Steps
    skipped_steps: Steps
    skipped_in_a_row: Steps = 0
    unusable: Mapping[str, Annotated[int, Within(0, 10**9, unit="samples")]]
    reports: tuple[StepReport, ...] = ()
    settings: Annotated[Mapping[str, Any], FINITE]
    model: str
    data_digest: str
    mixture: Mixture | None = None
    history: tuple[Event, ...] = ()
    world_size: Annotated[int, Within(1, 10**6, unit="processes")]
    threads: Annotated[int, Within(1, 10**6, unit="threads")] | None = None
    muon_precision: Precision | None = None
    extensions: Mapping[str, Sha256] = dataclasses.field(default_factory=dict)
    sha256: Sha256 | None = None

    def __post_init__(self) -> None:
        if self.skipped_steps > self.step:
            raise TrilightError(
                f"skipped_steps is {self.skipped_steps}; expected at most the {self.step} of step."
            )


def _encode_checkpoint(
    state: TrainState, settings: TrainSettings, data_digest: str, world_size: int
) -> bytes:
    """Return the bytes of a checkpoint without its sha256; later steps do not change them."""
    tensors = state.updater.optimizer_state()
    for name, weight in state.model.named_parameters():
        tensors[f"model/{name}"] = weight.detach()
    if state.ema_model is not None:
        for name, weight in state.ema_model.named_parameters():
            tensors[f"mean/{name}"] = weight
    header = {
        "step": state.step,
        "skipped_steps": state.skipped_steps,
        "skipped_in_a_row": state.skipped_in_a_row,
        "unusable": dict(state.bad_samples.counts),
        "reports": [dataclasses.asdict(report) for report in state.reports],
        "settings": stored_settings(settings),
        "model": encode_config(settings.model),
        "data_digest": data_digest,
        **({RECORD: state.mixture.record()} if state.mixture else {}),
        "history": event_records(state.history),
        "world_size": world_size,
        "threads": torch.get_num_threads(),
        "muon_precision": state.updater.muon_precision,
        **({"extensions": extensions} if (extensions := extension_digests("weights")) else {}),
        "sha256": UNSEALED,
    }
    contiguous = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    return save(contiguous, metadata={HEADER_KEY: json.dumps(header)})


def _write_sealed(path: Path, data: bytes) -> None:
    start = data.index(UNSEALED.encode())
    view = memoryview(data)
    seal = seal_of(data, UNSEALED).encode()
    with atomic_writer(path) as stream:
        for part in (view[:start], seal, view[start + len(seal) :]):
            stream.write(part)


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
        load_tensors(
            model, _tensors_under(self.arrays, "mean") or _tensors_under(self.arrays, "model")
        )
        return model.eval()


def is_checkpoint(metadata: Mapping[str, str]) -> bool:
    """Return whether the metadata of a safetensors file is that of a checkpoint."""
    return HEADER_KEY in metadata


def read_checkpoint(path: Path) -> Checkpoint:
    """Read and verify a checkpoint; raises TrilightError, with its path, if it is invalid."""
    try:
        data = read_plain(path)
        arrays, metadata = read_safetensors(data)
        if not is_checkpoint(metadata):
            raise TrilightError("it belongs to no run; expected one that `trilight train` wrote")
        seal = read_json(metadata[HEADER_KEY], _Header, "its header").sha256
        if seal and seal_of(data, seal) != seal:
            raise TrilightError("its bytes are not those that were written")
        for name, array in arrays.items():
            is_weight = name.startswith(("model/", "mean/"))
            if is_weight and not (array.dtype == np.float32 and np.isfinite(array).all()):
                raise TrilightError(f"{name} is {array.dtype}; expected finite float32 numbers")
    except (OSError, ValueError) as error:
        raise TrilightError(
            f"checkpoint {path} is not readable: {str(error).rstrip('.')}."
        ) from error
    return Checkpoint(header=json.loads(metadata[HEADER_KEY]), arrays=arrays)


def restore_state(
    checkpoint: Checkpoint,
    plan: ResumePlan,
    device: torch.device | None = None,
    muon_precision: Precision = "bfloat16",
) -> TrainState:
    """Return the state of a resumed run before its next step.

    Args:
        checkpoint: checkpoint to restore.
        plan: settings and history (train.resume). If the checkpoint has no EMA and the settings
            ask for one, it starts as a copy of the weights.
        device: as in `new_state`.
        muon_precision: as in `new_state`.

    Raises:
        TrilightError: the run was started with other extensions.
    """
    header = checkpoint.header
    settings = plan.settings
    require_same_extensions(
        "resume: the run", header.get("extensions", {}), extension_digests("weights")
    )
    state = new_state(
        settings, device, muon_precision=muon_precision, bad_counts=header["unusable"]
    )
    state.step = header["step"]
    state.skipped_steps = header["skipped_steps"]
    if not plan.changes_meaning:
        state.skipped_in_a_row = header.get("skipped_in_a_row", 0)
    state.history = plan.history
    state.reports = [StepReport(**fields) for fields in header.get("reports", ())]
    weights = _tensors_under(checkpoint.arrays, "model")
    load_tensors(state.model, weights)
    if state.ema_model is not None:
        load_tensors(state.ema_model, _tensors_under(checkpoint.arrays, "mean") or weights)
    if updates := state.step - state.skipped_steps:
        tensors = {name: torch.from_numpy(array) for name, array in checkpoint.arrays.items()}
        state.updater.load_optimizer_state(tensors, updates)
    return state


def _tensors_under(arrays: Mapping[str, NDArray], prefix: str) -> dict[str, Tensor]:
    start = f"{prefix}/"
    return {
        name.removeprefix(start): torch.from_numpy(array)
        for name, array in arrays.items()
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


def newest_checkpoint(
    folder: Path, dist_context: DistributedContext, note: Callable[[str], None]
) -> Checkpoint:
    """Return the newest checkpoint that is not damaged.

    Args:
        folder: folder of the checkpoints.
        dist_context: the processes that resume together; all must call it.
        note: called with a message if a damaged checkpoint was skipped.

    Raises:
        TrilightError: there is none, all are damaged, or the processes read different ones.
    """
    steps = saved_steps(folder)
    if not steps:
        raise TrilightError(
            f"{folder.parent}: no checkpoint here to resume from; start the run without --resume."
        )
    checkpoint = _newest_readable(folder, steps, note)
    step = checkpoint.header["step"]
    # bit by bit: a float32 mean of large numbers is rounded, and all processes must agree
    if any(0 < share < 1 for share in dist_context.mean([step >> bit & 1 for bit in range(32)])):
        raise TrilightError(
            f"{folder.parent}: the processes do not read the same checkpoint; this one reads that "
            f"of step {step}. Check that the folder is the same on every machine, and resume "
            "again."
        )
    return checkpoint


def _newest_readable(folder: Path, steps: list[int], note: Callable[[str], None]) -> Checkpoint:
    damaged = []
    for step in reversed(steps):
        try:
            checkpoint = read_checkpoint(path_of_step(folder, step))
        except TrilightError as error:
            damaged.append(str(error))
            continue
        if damaged:
            note(f"{' '.join(damaged)} The run goes on from that of step {step}")
        return checkpoint
    raise TrilightError(
        f"{folder.parent}: none of its checkpoints can be resumed from. {' '.join(damaged)} "
        "Restore one from a copy, or start the run again in another folder."
    )


def save_checkpoint(
    folder: Path,
    state: TrainState,
    settings: TrainSettings,
    *,
    data_digest: str,
    world_size: int,
    submit: Callable[[Callable[[], None]], None] = lambda work: work(),
) -> None:
    """Save the state atomically, then delete checkpoints that the settings do not keep.

    Kept are the newest `checkpoints_kept`, every multiple of `keep_every`, and the one where the
    decay of the learning rate begins, from which a longer run can be resumed. Checkpoints of later
    steps do not count: they were damaged when the run resumed from an earlier one.

    Args:
        folder: folder of the checkpoints.
        state: state to save; it is copied before this returns.
        settings: settings of the run.
        data_digest: digest of the training data.
        world_size: number of processes.
        submit: runs the slow writing; by default at once.

    Raises:
        TrilightError: the disk is full or the folder cannot be written; older checkpoints remain.
    """
    step = state.step
    data = _encode_checkpoint(state, settings, data_digest, world_size)
    submit(lambda: _write_and_prune(folder, step, data, settings))


def _write_and_prune(folder: Path, newest: int, data: bytes, settings: TrainSettings) -> None:
    _write_sealed(path_of_step(folder, newest), data)
    remove_leftovers(folder)
    passed = [step for step in saved_steps(folder) if step <= newest]
    for step in passed[: -settings.checkpoints_kept]:
        milestone = settings.keep_every and step % settings.keep_every == 0
        if not milestone and step != decay_start_step(settings):
            path_of_step(folder, step).unlink(missing_ok=True)


def network_of_run(path: Path) -> NetworkFile | None:
    """Return the network of a checkpoint, or of the folder of an unfinished run; else None.

    A checkpoint is read as a whole, since the digest of all its bytes verifies its header. The
    finished network of a run is a file of weights, which `model.open` reads.

    Args:
        path: any file or folder.

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
    stored = known_settings(checkpoint.header["settings"], f"checkpoint {path}")
    settings = from_record(TrainSettings, stored)
    return NetworkFile(
        path=path,
        trained=TrainedRange(resolution=settings.resolution),
        any_width=settings.model.view_stage == "hits",
        open=checkpoint.network,
    )

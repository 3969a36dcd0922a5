"""Checkpoints of a run: one safetensors file each, with all that changes while the run goes on.

It appears by rename, so a kill while saving leaves the previous one whole. It also names the
settings and the data, with what was decided about them since the run began (train.going_on),
because going on with others in silence would be neither the old run nor a new one; and it holds the
sha256 of itself, because safetensors would not notice a weight that a disk changed.
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

from model.open import FoundNetwork
from model.renderformer import RenderFormer
from model.weights import TrainedRange, decode_config, encode_config, load_tensors, read_metadata
from storage.atomic import atomic_writer, remove_leftovers
from storage.digests import seal_of
from storage.errors import TrilightError
from storage.extensions import recorded, require_same_extensions
from storage.records.safe_read import read_plain, read_safetensors
from storage.settings.described import from_record
from storage.settings.ranges import Within
from storage.typed_json import FINITE, Sha256, read_json
from train.data.mixture import RECORD, Mixture
from train.folder import RunFolder
from train.going_on import Event, GoingOn, event_records
from train.loop.crew import Crew
from train.loop.schedule import decay_begins
from train.loop.state import TrainState, new_state
from train.loop.step import StepReport
from train.settings import Precision, TrainSettings
from train.stored_settings import known_settings, stored_settings

PREFIX, SUFFIX = "step-", ".safetensors"
"""Names of the files, around the number of the step."""

HEADER_KEY = "trilight_checkpoint"
"""Metadata entry with counters, damage met, settings, digest of the data, how datasets are mixed,
the run's history, and how it was executed: number of processes and threads, precision of Muon's
products."""

UNSEALED = "0" * 64
"""Placeholder for the sha256 while it is computed. Old checkpoints have no sha256."""


Steps = Annotated[int, Within(0, 10**12, unit="steps")]


@dataclass(frozen=True, kw_only=True)
class _Header:
    """Header of a checkpoint, as `_encoded` writes it; older ones lack what has a default."""

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


def _encoded(
    state: TrainState, settings: TrainSettings, data_digest: str, world_size: int
) -> bytes:
    """Return a copy of all that a checkpoint holds, without its sha256; steps may go on."""
    tensors = state.updater.memories()
    for name, weight in state.model.named_parameters():
        tensors[f"model/{name}"] = weight.detach()
    if state.mean_model is not None:
        for name, weight in state.mean_model.named_parameters():
            tensors[f"mean/{name}"] = weight
    header = {
        "step": state.step,
        "skipped_steps": state.skipped_steps,
        "skipped_in_a_row": state.skipped_in_a_row,
        "unusable": dict(state.unusable.met),
        "reports": [dataclasses.asdict(report) for report in state.reports],
        "settings": stored_settings(settings),
        "model": encode_config(settings.model),
        "data_digest": data_digest,
        **({RECORD: state.mixture.record()} if state.mixture else {}),
        "history": event_records(state.history),
        "world_size": world_size,
        "threads": torch.get_num_threads(),
        "muon_precision": state.updater.muon_precision,
        **({"extensions": found} if (found := recorded("weights")) else {}),
        "sha256": UNSEALED,
    }
    contiguous = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
    return save(contiguous, metadata={HEADER_KEY: json.dumps(header)})


def _write_sealed(path: Path, data: bytes) -> None:
    start, view = data.index(UNSEALED.encode()), memoryview(data)
    seal = seal_of(data, UNSEALED).encode()
    with atomic_writer(path) as stream:
        for part in (view[:start], seal, view[start + len(seal) :]):
            stream.write(part)


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """A checkpoint as it was read."""

    header: Mapping[str, Any]
    """Step, settings, digest of the data, history, number of processes."""
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


def resumed_state(
    checkpoint: Checkpoint,
    going: GoingOn,
    device: torch.device | None = None,
    muon_precision: Precision = "bfloat16",
) -> TrainState:
    """Return the state of a run, ready for its next step.

    Args:
        checkpoint: where it goes on.
        going: how (train.going_on.going_on). Where only its settings have a running mean, that
            begins with the weights.
        device: as in `new_state`.
        muon_precision: as in `new_state`.

    Raises:
        TrilightError: the run has begun with other extensions.
    """
    header, settings = checkpoint.header, going.settings
    require_same_extensions("resume: the run", header.get("extensions", {}), recorded("weights"))
    state = new_state(settings, device, muon_precision=muon_precision, met=header["unusable"])
    state.step, state.skipped_steps = header["step"], header["skipped_steps"]
    if not going.has_decided:
        state.skipped_in_a_row = header.get("skipped_in_a_row", 0)
    state.history = going.history
    state.reports = [StepReport(**fields) for fields in header.get("reports", ())]
    weights = _part(checkpoint.arrays, "model")
    load_tensors(state.model, weights)
    if state.mean_model is not None:
        load_tensors(state.mean_model, _part(checkpoint.arrays, "mean") or weights)
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


def saved_steps(folder: Path) -> list[int]:
    """Return the steps of which there is a checkpoint, oldest first."""
    names = [path.name for path in folder.glob(f"{PREFIX}*{SUFFIX}")]
    digits = [name.removeprefix(PREFIX).removesuffix(SUFFIX) for name in names]
    return sorted(int(text) for text in digits if text.isdecimal())


def path_of_step(folder: Path, step: int) -> Path:
    """Return where the checkpoint of a step is."""
    return folder / f"{PREFIX}{step:09d}{SUFFIX}"


def resumed_checkpoint(folder: Path, crew: Crew, noted: Callable[[str], None]) -> Checkpoint:
    """Return the newest checkpoint that is whole.

    Args:
        folder: of the checkpoints.
        crew: the processes that go on together; all must call it.
        noted: called with a note where a damaged one was passed over.

    Raises:
        TrilightError: there is none, none is whole, or a process reads another than this one.
    """
    steps = saved_steps(folder)
    if not steps:
        raise TrilightError(
            f"{folder.parent}: no checkpoint here to resume from; start the run without --resume."
        )
    checkpoint = _newest_whole(folder, steps, noted)
    step = checkpoint.header["step"]
    # bit by bit, since a float32 mean of a large number is rounded, and all must reach one verdict
    if any(0 < share < 1 for share in crew.mean([step >> bit & 1 for bit in range(32)])):
        raise TrilightError(
            f"{folder.parent}: the processes do not read the same checkpoint; this one reads that "
            f"of step {step}. Check that the folder is the same on every machine, and resume "
            "again."
        )
    return checkpoint


def _newest_whole(folder: Path, steps: list[int], noted: Callable[[str], None]) -> Checkpoint:
    damaged = []
    for step in reversed(steps):
        try:
            checkpoint = read_checkpoint(path_of_step(folder, step))
        except TrilightError as error:
            damaged.append(str(error))
            continue
        if damaged:
            noted(f"{' '.join(damaged)} The run goes on from that of step {step}")
        return checkpoint
    raise TrilightError(
        f"{folder.parent}: none of its checkpoints can be resumed from. {' '.join(damaged)} "
        "Restore one from a copy, or start the run again in another folder."
    )


def keep_checkpoint(
    folder: Path,
    state: TrainState,
    settings: TrainSettings,
    *,
    data_digest: str,
    world_size: int,
    begin: Callable[[Callable[[], None]], None] = lambda work: work(),
) -> None:
    """Save the state, whole or not at all, and only then delete what the run does not keep.

    Kept are the newest `checkpoints_kept`, every multiple of `keep_every`, and the one where the
    decay of the learning rate begins, from which a longer run can go on. One of a later step was
    damaged when the run resumed from an earlier one, and does not count.

    Args:
        folder: of the checkpoints.
        state: is copied before this returns.
        settings: of the run.
        data_digest: of what it learns from.
        world_size: number of processes.
        begin: does the writing, which takes as long as the disk: at once unless said.

    Raises:
        TrilightError: the folder is full or cannot be written; the older ones are still there.
    """
    step = state.step
    data = _encoded(state, settings, data_digest, world_size)
    begin(lambda: _put(folder, step, data, settings))


def _put(folder: Path, newest: int, data: bytes, settings: TrainSettings) -> None:
    _write_sealed(path_of_step(folder, newest), data)
    remove_leftovers(folder)
    passed = [step for step in saved_steps(folder) if step <= newest]
    for step in passed[: -settings.checkpoints_kept]:
        milestone = settings.keep_every and step % settings.keep_every == 0
        if not milestone and step != decay_begins(settings):
            path_of_step(folder, step).unlink(missing_ok=True)


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
    stored = known_settings(checkpoint.header["settings"], f"checkpoint {path}")
    settings = from_record(TrainSettings, stored)
    return FoundNetwork(
        path=path,
        trained=TrainedRange(resolution=settings.resolution),
        any_width=settings.model.view_stage == "hits",
        open=checkpoint.network,
    )

"""Checkpoints of a run: one safetensors file each, with the whole mutable state.

That is weights, averages and the optimizer's state dict; no RNG state (no set_rng_state): all
randomness follows from seed and step.

A checkpoint appears by rename, so that a kill while saving leaves the previous one intact. It also
holds the settings, the digest of the data and the decisions about them (train.resume), so that a
resume with others is detected; and its own sha256, because safetensors does not detect a weight
that a disk changed.
"""

import dataclasses
import json
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from safetensors.torch import save

from model.open import HEADER_KEY, Checkpoint, path_of_step, saved_steps
from model.open import read_checkpoint as read_network_checkpoint
from model.weights import encode_config, load_tensors
from storage.atomic import atomic_writer, remove_leftovers
from storage.digests import seal_of
from storage.errors import TrilightError
from storage.extensions import extension_digests, require_same_extensions
from storage.settings.ranges import Within
from storage.typed_json import FINITE, Sha256
from train.data.order import RECORD, Mixture
from train.loop.distributed import DistributedContext
from train.loop.step import StepReport
from train.loop.train_state import TrainState, new_state
from train.resume import Event, StartPlan
from train.settings import Precision, decay_start_step, stored_settings

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


def _encode_checkpoint(state: TrainState, world_size: int) -> bytes:
    """Return the bytes of a checkpoint without its sha256; later steps do not change them."""
    tensors = state.optimizer.optimizer_state()
    for part, network in (("model", state.model), ("mean", state.ema_model)):
        if network is not None:
            for name, weight in network.named_parameters():
                tensors[f"{part}/{name}"] = weight.detach()
    header = {
        "step": state.step,
        "skipped_steps": state.skipped_steps,
        "skipped_in_a_row": state.skipped_in_a_row,
        "unusable": dict(state.bad_samples.counts),
        "reports": [dataclasses.asdict(report) for report in state.reports],
        "settings": stored_settings(state.settings),
        "model": encode_config(state.settings.model),
        "data_digest": state.data_digest,
        **({RECORD: dataclasses.asdict(state.mixture)} if state.mixture else {}),
        "history": [dataclasses.asdict(event) for event in state.history],
        "world_size": world_size,
        "threads": torch.get_num_threads(),
        "muon_precision": state.optimizer.muon_precision,
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


def read_checkpoint(path: Path) -> Checkpoint:
    """Read and verify a checkpoint; raises TrilightError, with its path, if it is invalid."""
    return read_network_checkpoint(path, _Header)


def restore_state(
    checkpoint: Checkpoint,
    plan: StartPlan,
    device: torch.device | None = None,
    muon_precision: Precision = "bfloat16",
) -> TrainState:
    """Return the state of a resumed run before its next step.

    Args:
        plan: settings and history (train.resume). If the checkpoint has no EMA and the settings
            ask for one, it starts as a copy of the weights.

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
    weights = checkpoint.tensors_under("model")
    load_tensors(state.model, weights)
    if state.ema_model is not None:
        load_tensors(state.ema_model, checkpoint.tensors_under("mean") or weights)
    if updates := state.step - state.skipped_steps:
        tensors = {name: torch.from_numpy(array) for name, array in checkpoint.arrays.items()}
        state.optimizer.load_optimizer_state(tensors, updates)
    return state


def newest_checkpoint(
    folder: Path, dist_context: DistributedContext, note: Callable[[str], None]
) -> Checkpoint:
    """Return the newest checkpoint that is not damaged.

    Args:
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
    damaged = []
    for step in reversed(steps):
        try:
            checkpoint = read_checkpoint(path_of_step(folder, step))
            break
        except TrilightError as error:
            damaged.append(str(error))
    else:
        raise TrilightError(
            f"{folder.parent}: none of its checkpoints can be resumed from. {' '.join(damaged)} "
            "Restore one from a copy, or start the run again in another folder."
        )
    if damaged:
        note(f"{' '.join(damaged)} The run goes on from that of step {step}")
    if len(set(dist_context.gather_text(str(step)))) > 1:
        raise TrilightError(
            f"{folder.parent}: the processes do not read the same checkpoint; this one reads that "
            f"of step {step}. Check that the folder is the same on every machine, and resume "
            "again."
        )
    return checkpoint


def save_checkpoint(
    folder: Path,
    state: TrainState,
    *,
    world_size: int,
    submit: Callable[[Callable[[], None]], None] = lambda work: work(),
) -> None:
    """Save the state atomically, then delete checkpoints that the settings do not keep.

    Kept are the newest `checkpoints_kept`, every multiple of `keep_every`, and the one where the
    decay of the learning rate begins, from which a longer run can be resumed. Checkpoints of later
    steps do not count: they were damaged when the run resumed from an earlier one.

    Args:
        state: state to save; it is copied before this returns.
        submit: runs the slow writing; by default at once.

    Raises:
        TrilightError: the disk is full or the folder cannot be written; older checkpoints remain.
    """
    step = state.step
    settings = state.settings
    data = _encode_checkpoint(state, world_size)

    def write_and_prune() -> None:
        _write_sealed(path_of_step(folder, step), data)
        remove_leftovers(folder)
        passed = [saved for saved in saved_steps(folder) if saved <= step]
        for old in passed[: -settings.checkpoints_kept]:
            milestone = settings.keep_every and old % settings.keep_every == 0
            if not milestone and old != decay_start_step(settings):
                path_of_step(folder, old).unlink(missing_ok=True)

    submit(write_and_prune)


class BackgroundWriter:
    """Thread that runs one job at a time.

    Errors of a job are raised by the next call, so that only time is lost. The context exits when
    all jobs are done.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._last: Future[None] | None = None

    def begin(self, work: Callable[[], None]) -> None:
        """Submit a job after the one before has ended; raises the error of that."""
        self.wait()
        self._last = self._pool.submit(work)

    def wait(self) -> None:
        """Wait until the submitted job has ended; raises its error."""
        last = self._last
        self._last = None
        if last is not None:
            last.result()

    def __enter__(self) -> "BackgroundWriter":
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        try:
            self.wait()
        except TrilightError as failed:
            if error is None:
                raise
            error.add_note(str(failed))
        finally:
            self._pool.shutdown()

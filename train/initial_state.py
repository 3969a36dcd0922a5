"""Initial or resumed state of a run, and the settings.json that records it."""

import dataclasses
import platform
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from model.checkpoint_format import Checkpoint, find_checkpoint, read_header, saved_steps
from model.open import open_network
from model.renderformer import RenderFormer
from model.weights import decode_config, encode_weights
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.extensions import extension_digests
from storage.records.safe_read import read_plain
from storage.typed_json import read_json
from train.data.order import RECORD, plan_mixture
from train.folder import RunFolder, copy_rows, pretty_json
from train.loop.checkpoints import (
    newest_checkpoint,
    read_checkpoint,
    restore_state,
    save_checkpoint,
)
from train.loop.distributed import DistributedContext
from train.loop.optimizer import choose_muon_precision
from train.loop.train_state import TrainState, new_state
from train.resume import Event, ResumePlan, StartOptions, event_records, plan_resume
from train.settings import TrainSettings, stored_settings


@dataclass(frozen=True, kw_only=True, eq=False)
class StartPlan(ResumePlan):
    """Everything that a run starts or resumes with; nothing is written yet."""

    network: RenderFormer | None = None
    """Network whose weights are copied; None for random weights or a checkpoint."""
    network_source: str = ""
    """Path or name from which that network was opened."""
    checkpoint: Checkpoint | None = None
    """Checkpoint that is restored; None for a new run."""
    branch: Path | None = None
    """Checkpoint or run folder that a new folder continues; None otherwise."""


def plan_start(
    settings: TrainSettings,
    folder: RunFolder,
    data_digest: str,
    start: StartOptions,
    dist_context: DistributedContext,
    note: Callable[[str], None],
) -> StartPlan:
    """Read what the run starts or resumes with, without writing anything.

    Raises:
        TrilightError: the folder holds a run already, or has none to resume; the checkpoint is
            damaged; or settings or data differ from the run's without a recorded decision.
    """
    # alike in all processes: torchrun counts restarts for each machine separately, and a network
    # file system shows a new file to one machine before another
    has_checkpoint = dist_context.any(start.restartable and bool(saved_steps(folder.checkpoints)))
    start = dataclasses.replace(start, resume=start.resume or has_checkpoint, restartable=False)
    if not start.resume and saved_steps(folder.checkpoints):
        raise TrilightError(
            f"{folder.root}: holds a run already; add --resume to go on with it, or choose "
            "another --out."
        )
    start.check(settings)
    if not start.continues_run:
        source = start.begin_with
        if source is None:
            return StartPlan(settings=settings)
        network = open_network(source)
        settings = dataclasses.replace(settings, model=network.config)
        return StartPlan(settings=settings, network=network, network_source=source)
    branch = None if start.resume or start.branch is None else Path(start.branch)
    if branch is None or branch.is_dir():
        checkpoints = (folder if branch is None else RunFolder(branch)).checkpoints
        checkpoint = newest_checkpoint(checkpoints, dist_context, note)
    else:
        checkpoint = read_checkpoint(branch)
        # the first process soon writes into the folder that all have looked at
        dist_context.barrier()
    if settings.from_weights:
        config = decode_config(checkpoint.header["model"], str(branch or folder.root))
        settings = dataclasses.replace(settings, model=config)
    resume_plan = plan_resume(checkpoint.header, settings, data_digest, start.decisions)
    return StartPlan(**vars(resume_plan), checkpoint=checkpoint, branch=branch)


def init_or_resume_state(
    plan: StartPlan,
    folder: RunFolder,
    data: TrainingData,
    dist_context: DistributedContext,
    note: Callable[[str], None],
) -> TrainState:
    """Create or restore the state before the run's next step, and record it on disk.

    A run that has just started, branched or changed its meaning is on disk when this returns.

    Raises:
        TrilightError: `data_weights` has another length than the list of datasets.
    """
    device = dist_context.device
    precision = choose_muon_precision(dist_context)
    header = None if plan.checkpoint is None else plan.checkpoint.header
    mixture = plan_mixture(data, plan.settings, header)
    if mixture is not None:
        note(f"the stream mixes {mixture}")
    digest = None
    if plan.checkpoint is None or header is None:
        state = new_state(plan.settings, device, plan.network, precision)
        if plan.network is not None:
            digest = sha256_hex(encode_weights(plan.network))
            source = find_checkpoint(Path(plan.network_source))
            before = {**(read_header(source) if source else {}), "sha256": digest}
            state.history = (_origin(0, "weights", before),)
    else:
        state = restore_state(plan.checkpoint, plan, device, precision)
        if plan.branch is not None:
            state.history += (_origin(state.step, "checkpoint", header),)
        for text in plan.notes:
            note(text)
        state.history += tuple(_execution_changes(header, dist_context, state, note))
    state.mixture = mixture
    state.data_digest = data.digest
    if dist_context.is_first:  # on disk, so that a kill before the next checkpoint loses nothing
        if plan.branch is not None:
            root = plan.branch if plan.branch.is_dir() else plan.branch.parent.parent
            copy_rows(RunFolder(root).metrics, folder.metrics, state.step)
        _write_settings(folder, state, dist_context, digest)
        if plan.branch is not None or (header is not None and plan.changes_meaning):
            save_checkpoint(folder.checkpoints, state, world_size=dist_context.world_size)
    return state


def _origin(step: int, name: str, header: Mapping[str, Any]) -> Event:
    """Return the event of what a run started with; it holds no path of the user's machine."""
    settings = header.get("settings", {})
    after = {
        "run": settings.get("run"),
        "step": header.get("step"),
        "sha256": header.get("sha256"),
    }
    return Event(step=step, kind="origin", name=name, after=after)


def _write_settings(
    folder: RunFolder,
    state: TrainState,
    dist_context: DistributedContext,
    begun_with: str | None,
) -> None:
    """Write settings.json: current settings, their history, and how the run started."""
    origin = {
        "begun_with_sha256": begun_with,
        **({"extensions": extensions} if (extensions := extension_digests("weights")) else {}),
        "versions": {"torch": torch.__version__, "python": platform.python_version()},
        "threads": torch.get_num_threads(),
        "processes": dist_context.world_size,
        "muon_precision": state.optimizer.muon_precision,
    }
    now = {
        "settings": stored_settings(state.settings),
        "data_digest": state.data_digest,
        **({RECORD: dataclasses.asdict(state.mixture)} if state.mixture else {}),
        "history": event_records(state.history),
    }
    write_atomically(folder.settings, pretty_json(origin | _read_settings(folder) | now))


def _read_settings(folder: RunFolder) -> dict[str, Any]:
    """Return the stored settings.json, or an empty record if it is missing or damaged."""
    try:
        return read_json(read_plain(folder.settings), dict[str, Any], str(folder.settings))
    except (OSError, TrilightError):
        return {}


def _execution_changes(
    header: Mapping[str, Any],
    dist_context: DistributedContext,
    state: TrainState,
    note: Callable[[str], None],
) -> Iterator[Event]:
    """Report and yield changed processes, threads and Muon precision."""
    now: dict[str, tuple[Any, Any]] = {
        "processes": (header["world_size"], dist_context.world_size),
        "threads": (header.get("threads"), torch.get_num_threads()),
        # the only one that there was
        "muon_precision": (
            header.get("muon_precision", "bfloat16"),
            state.optimizer.muon_precision,
        ),
    }
    for name, (before, after) in now.items():
        if None in (before, after) or before == after:
            continue
        text = f"{after} {name} instead of {before}: the same to rounding, not to the bit"
        if name == "muon_precision":
            text = (
                f"Muon's products in {after} instead of {before}, which suits the processors here: "
                "the same to the rounding of bfloat16, not to the bit"
            )
        note(f"the run goes on with {text}")
        yield Event(step=state.step, kind="execution", name=name, before=before, after=after)

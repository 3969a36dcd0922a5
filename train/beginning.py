"""The state with which a run begins or goes on, and settings.json, which says so."""

import dataclasses
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from model.open import open_network
from model.renderformer import RenderFormer
from model.weights import decode_config, encode_weights, read_metadata
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.extensions import recorded
from storage.records.safe_read import read_plain
from storage.typed_json import read_json
from train.data.mixture import RECORD, mixture_of
from train.folder import RunFolder
from train.going_on import Event, GoingOn, event_records, going_on
from train.loop.checkpoints import (
    HEADER_KEY,
    Checkpoint,
    is_checkpoint,
    keep_checkpoint,
    network_of_run,
    path_of_step,
    read_checkpoint,
    resumed_checkpoint,
    resumed_state,
    saved_steps,
)
from train.loop.crew import Crew
from train.loop.muon import fitting_precision
from train.loop.recorder import MetricsLog
from train.loop.state import TrainState, new_state
from train.progress import TrainProgress
from train.result import pretty_json
from train.settings import TrainSettings
from train.start import Start
from train.stored_settings import stored_settings
from train.watching.rows import read_rows


@dataclass(frozen=True, kw_only=True, eq=False)
class Beginning:
    """What a run begins or goes on with."""

    settings: TrainSettings
    """The run's, as they are now."""
    network: RenderFormer | None = None
    """Whose weights it takes over; None where it goes on, or begins with random ones."""
    network_place: str = ""
    """Where that network was opened."""
    checkpoint: Checkpoint | None = None
    """From which it goes on."""
    going: GoingOn | None = None
    """How it goes on."""
    branch: Path | None = None
    """The checkpoint or run that it leaves for a folder of its own."""


def beginning(
    settings: TrainSettings,
    folder: RunFolder,
    data_digest: str,
    start: Start,
    crew: Crew,
    progress: TrainProgress,
) -> Beginning:
    """Read what the run begins or goes on with; nothing is written yet.

    Raises:
        TrilightError: the folder holds a run, or lacks one; a checkpoint that is damaged; settings
            or data that are not the run's and were not decided on.
    """
    if not start.resume and saved_steps(folder.checkpoints):
        raise TrilightError(
            f"{folder.root}: holds a run already; add --resume to go on with it, or choose "
            "another --out."
        )
    start.check(settings)
    if not start.goes_on:
        place = start.begin_with
        if place is None:
            return Beginning(settings=settings)
        network = open_network(place, network_of_run)
        settings = dataclasses.replace(settings, model=network.config)
        return Beginning(settings=settings, network=network, network_place=place)
    branch = None if start.resume or start.branch is None else Path(start.branch)
    if branch is None or branch.is_dir():
        checkpoints = (folder if branch is None else RunFolder(branch)).checkpoints
        checkpoint = resumed_checkpoint(checkpoints, crew, progress.noted)
    else:
        checkpoint = read_checkpoint(branch)
        crew.any(False)  # a barrier: the first process soon writes what was just looked for
    if settings.from_weights:
        config = decode_config(checkpoint.header["model"], str(branch or folder.root))
        settings = dataclasses.replace(settings, model=config)
    going = going_on(checkpoint.header, settings, data_digest, start.decisions)
    return Beginning(settings=going.settings, checkpoint=checkpoint, going=going, branch=branch)


def begun(
    plan: Beginning, folder: RunFolder, data: TrainingData, crew: Crew, progress: TrainProgress
) -> TrainState:
    """Return the state before the run's next step.

    A run that has just begun, branched or changed its meaning is on disk when this returns.

    Raises:
        TrilightError: not as many weights of datasets as there are.
    """
    precision, data_digest = fitting_precision(crew), data.digest
    header = None if plan.checkpoint is None else plan.checkpoint.header
    mixture = mixture_of(data, plan.settings, header)
    if mixture is not None:
        progress.noted(f"the stream mixes {mixture}")
    if plan.checkpoint is None or plan.going is None:
        state = new_state(plan.settings, crew.device, plan.network, precision)
        state.mixture = mixture
        digest = None
        if plan.network is not None:
            digest = sha256_hex(encode_weights(plan.network))
            header = _header_of(Path(plan.network_place)) | {"sha256": digest}
            state.history = (_origin(0, "weights", header),)
        if crew.is_first:
            more = {"begun_with_sha256": digest}
            _write_settings(folder, plan.settings, state, data_digest, crew, more)
        return state
    state = resumed_state(plan.checkpoint, plan.going, crew.device, precision)
    state.mixture = mixture
    if plan.branch is not None:
        state.history += (_origin(state.step, "checkpoint", plan.checkpoint.header),)
    for note in plan.going.notes:
        progress.noted(note)
    _note_other_execution(plan.checkpoint, crew, state, progress)
    if crew.is_first:
        _write_down(plan, folder, state, data_digest, crew)
    return state


def _write_down(
    plan: Beginning, folder: RunFolder, state: TrainState, data_digest: str, crew: Crew
) -> None:
    """Write how a run goes on, so that a kill before its next checkpoint forgets nothing."""
    if plan.branch is not None:
        _take_log(plan.branch, folder, state.step)
    _write_settings(folder, plan.settings, state, data_digest, crew)
    if plan.branch is not None or (plan.going is not None and plan.going.has_decided):
        keep_checkpoint(
            folder.checkpoints,
            state,
            plan.settings,
            data_digest=data_digest,
            world_size=crew.world_size,
        )


def _origin(step: int, name: str, header: Mapping[str, Any]) -> Event:
    """Return the event that says what a run began with, without the place where that lay."""
    settings = header.get("settings", {})
    after = {
        "run": settings.get("run"),
        "step": header.get("step"),
        "sha256": header.get("sha256"),
    }
    return Event(step=step, kind="origin", name=name, after=after)


def _header_of(place: Path) -> dict[str, Any]:
    """Return the header of the checkpoint that weights are taken from; empty where it is none."""
    if place.is_dir() and (steps := saved_steps(RunFolder(place).checkpoints)):
        place = path_of_step(RunFolder(place).checkpoints, steps[-1])
    if place.suffix != ".safetensors" or not place.is_file():
        return {}
    metadata = read_metadata(place)
    return dict(json.loads(metadata[HEADER_KEY])) if is_checkpoint(metadata) else {}


def _take_log(place: Path, folder: RunFolder, step: int) -> None:
    """Begin the log of a branch with that of its run, up to the step where it leaves it."""
    of_run = RunFolder(place if place.is_dir() else place.parent.parent)
    log = MetricsLog(folder.metrics, first_step=0)
    for row in read_rows(of_run.metrics):
        if row["step"] <= step:
            log.append(row)


def _write_settings(
    folder: RunFolder,
    settings: TrainSettings,
    state: TrainState,
    data_digest: str,
    crew: Crew,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Write settings.json: what the run is now, how it came to be so, and where it began."""
    begun = {
        "begun_with_sha256": None,
        **({"extensions": found} if (found := recorded("weights")) else {}),
        "versions": {"torch": torch.__version__, "python": platform.python_version()},
        "threads": torch.get_num_threads(),
        "processes": crew.world_size,
        "muon_precision": state.updater.muon_precision,
        **(more or {}),
    }
    now = {
        "settings": stored_settings(settings),
        "data_digest": data_digest,
        **({RECORD: state.mixture.record()} if state.mixture else {}),
        "history": event_records(state.history),
    }
    write_atomically(folder.settings, pretty_json(begun | _read_settings(folder) | now))


def _read_settings(folder: RunFolder) -> dict[str, Any]:
    """Return what settings.json says of the run's beginning; nothing where there is none."""
    try:
        return read_json(read_plain(folder.settings), dict[str, Any], str(folder.settings))
    except (OSError, TrilightError):
        return {}


def _note_other_execution(
    checkpoint: Checkpoint, crew: Crew, state: TrainState, progress: TrainProgress
) -> None:
    """Note and record what differs in how the run is executed, beside its settings."""
    header, muon = checkpoint.header, state.updater.muon_precision
    now = {
        "processes": (header["world_size"], crew.world_size),
        "threads": (header.get("threads"), torch.get_num_threads()),
        # the only one that there was
        "muon_precision": (header.get("muon_precision", "bfloat16"), muon),
    }
    said = {
        "processes": f"{crew.world_size} processes instead of {header['world_size']}: the same to "
        "rounding, not to the bit",
        "threads": f"{torch.get_num_threads()} threads instead of {header.get('threads')}: the "
        "same to rounding, not to the bit",
        "muon_precision": f"Muon's products in {muon} instead of {now['muon_precision'][0]}, which "
        "suits the processors here: the same to the rounding of bfloat16, not to the bit",
    }
    for name, (before, after) in now.items():
        if before is None or after is None or before == after:
            continue
        progress.noted(f"the run goes on with {said[name]}")
        event = Event(step=state.step, kind="execution", name=name, before=before, after=after)
        state.history += (event,)

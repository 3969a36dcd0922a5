"""Options of how a run starts, and the plan by which it resumes; without torch.

A command that resumes states the run as it was started. Its execution settings are used as given.
All other settings have to equal those of the checkpoint, except for named changes (`--change`),
each of which the run records.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from storage.errors import TrilightError
from storage.settings.described import checked, from_record, settings_record
from storage.settings.fields import describe_fields
from storage.settings.overrides import apply_overrides, values_by_name
from train.settings import TrainSettings, decay_start_step, known_settings

if TYPE_CHECKING:
    from model.open import Checkpoint
    from model.renderformer import RenderFormer

DATA = "data"
"""Name of the change to other data. Its value is the start of their digest, after `sha256:` for a
dataset and `list:` for listed shards, so that digits are never parsed as a number."""

_FIXED = ("run", "from_weights", "model", "base_widths")
"""Settings that cannot change within a run."""

_LEAST_DIGITS = 8
"""Minimum number of digits that identify a digest; fewer could match other data."""

_HOW = "--set from_weights"

_EXECUTION = frozenset(field.name for field in describe_fields(TrainSettings) if field.is_execution)


@checked()
class StartOptions:
    """How a run starts or resumes.

    On the CPU, with the same number of threads and processes, a resumed run has exactly the weights
    of an uninterrupted one. A finished run is judged again. A run that resumes has branched already
    and ignores `branch`.
    """

    resume: bool = False
    """Continue from the newest checkpoint, with the settings of the start. Settings of execution
    may differ."""
    restartable: bool = False
    """Resume if the folder has a checkpoint, else begin. A scheduler may then start the same
    command repeatedly; a restart by torchrun always resumes."""
    branch: str | None = None
    """Checkpoint, or folder of a run, to continue in a new folder; by default none."""
    decisions: Mapping[str, Any] = field(default_factory=dict)
    """Recorded changes with --resume or --branch, such as num_steps=20000; by default none. They
    apply from the checkpoint on."""
    begin_with: str | None = None
    """Run folder or checkpoint with the initial weights of a finetune run; by default random
    weights."""
    lpips: str | None = None
    """Folder of vgg16-397923af.pth and vgg.pth (LPIPS), or hub; by default the value of
    TRILIGHT_LPIPS."""

    @property
    def continues_run(self) -> bool:
        """True if the run starts from a checkpoint, not from weights alone."""
        return self.resume or self.branch is not None

    def check(self, settings: TrainSettings) -> None:
        """Raise if these options contradict the run's settings; a resumed run is not checked.

        Raises:
            TrilightError: `from_weights` and `begin_with` disagree; both a branch and weights are
                given; or settings are changed of a run that has not started.
        """
        if self.branch is not None and self.begin_with is not None:
            raise TrilightError(
                f"run {settings.run}: branch is {self.branch} and begin_with is {self.begin_with}; "
                "expected one of them: the whole state of a run, or its weights alone."
            )
        if self.continues_run:
            return
        if self.decisions and not self.restartable:
            name = next(iter(self.decisions))
            raise TrilightError(
                f"run {settings.run}: it has not begun, so --change {name} changes nothing; "
                "expected --set, or --resume or --branch to go on with a run."
            )
        if settings.from_weights and self.begin_with is None:
            raise TrilightError(
                f"run {settings.run}: begins with trained weights, and none are named; expected "
                f"begin_with, or {_HOW}=false to begin with random weights."
            )
        if self.begin_with is not None and not settings.from_weights:
            raise TrilightError(
                f"run {settings.run}: begins with random weights, but begin_with is "
                f"{self.begin_with}; expected none, or {_HOW}=true to begin with those."
            )


@dataclass(frozen=True, kw_only=True)
class Event:
    """Recorded change of a run between two steps."""

    step: int
    """Number of steps that were done by then."""
    kind: Literal["origin", "meaning", "execution", "earlier"]
    """`origin`: the weights or checkpoint of the start; `meaning`: a decision; `execution`: another
    execution setting; `earlier`: the run is older than a setting and keeps its value (`after`),
    whatever the command states (`before`)."""
    name: str
    """Name of the setting, or `data`, `processes`, `threads`; `weights` or `checkpoint` of an
    origin."""
    before: Any = None
    """Value until that step; None of an origin."""
    after: Any = None
    """Value from that step on; of an origin the run, its step and the sha256 of its weights."""


@dataclass(frozen=True, kw_only=True)
class StartPlan:
    """Everything that a run starts or resumes with; nothing is written yet."""

    settings: TrainSettings
    """Settings of the next step."""
    history: tuple[Event, ...] = ()
    """All events so far, oldest first, including those of this resume."""
    notes: tuple[str, ...] = ()
    """Messages for the user, one per change."""
    changes_meaning: bool = True
    """True if this resume changes a setting or the data that decide the weights."""
    network: "RenderFormer | None" = None
    """Network whose weights are copied; None for random weights or a checkpoint."""
    checkpoint: "Checkpoint | None" = None
    """Checkpoint that is restored; None for a new run."""
    branch: Path | None = None
    """Checkpoint or run folder that a new folder continues; None otherwise."""


def plan_resume(
    header: Mapping[str, Any],
    typed: TrainSettings,
    data_digest: str,
    decisions: Mapping[str, Any],
) -> StartPlan:
    """Return the plan to resume a run from a checkpoint.

    Args:
        header: header of the checkpoint (train.loop.checkpoints).
        typed: the run as the command states it, as it was started or as it is now.
        data_digest: digest of the data of this call.
        decisions: settings by dotted name, and `data`, that change from here on.

    Raises:
        TrilightError: settings or data differ and were not decided on; the message names all of
            them, both values and both remedies. A change that no run allows, or one of execution.
    """
    step = header["step"]
    before = from_record(TrainSettings, known_settings(header["settings"], "checkpoint"))
    old = dict(values_by_name(settings_record(before)))
    past_events = tuple(Event(**record) for record in header.get("history", ()))
    named_decisions = {name: value for name, value in decisions.items() if name != DATA}
    for name, value in named_decisions.items():
        if name in _EXECUTION:
            raise TrilightError(
                f"--change {name}: it is execution, which is free when a run goes on; expected "
                f"--set {name}={_to_text(value)}."
            )
    typed_otherwise = _differing(old, typed)
    execution_changes = {n: value for n, value in typed_otherwise.items() if n in _EXECUTION}
    settings = apply_overrides(before, execution_changes | named_decisions)
    new_values = _differing(old, settings)
    stated = _original_values(past_events)
    stored_names = dict(values_by_name(header["settings"]))
    events = list[Event]()
    undecided = dict[str, Any]()
    for name, value in typed_otherwise.items():
        if name in new_values or value in stated.get(name, ()):
            continue
        if name in stored_names:
            undecided[name] = value
        else:
            events.append(
                Event(step=step, kind="earlier", name=name, before=value, after=old[name])
            )
    if undecided:
        raise _undecided_error(old, undecided)
    for name, value in new_values.items():
        kind: Literal["execution", "meaning"] = "execution" if name in _EXECUTION else "meaning"
        events.append(Event(step=step, kind=kind, name=name, before=old[name], after=value))
    events += _data_event(header, data_digest, decisions.get(DATA))
    _require_possible(before, settings, step, events)
    return StartPlan(
        settings=settings,
        history=(*past_events, *events),
        notes=tuple(_notes(before, settings, step, past_events, events)),
        changes_meaning=any(event.kind == "meaning" for event in events),
    )


def _differing(old: Mapping[str, Any], settings: TrainSettings) -> dict[str, Any]:
    """Return the values that are not the old ones, by dotted name."""
    now = values_by_name(settings_record(settings))
    return {name: value for name, value in now if value != old[name]}


def _original_values(past: Sequence[Event]) -> dict[str, list[Any]]:
    """Return, by setting, the earlier values that a command may still state."""
    stated: dict[str, list[Any]] = {}
    for event in past:
        values = [event.before, event.after] if event.kind == "earlier" else [event.before]
        stated.setdefault(event.name, values)
    return stated


def _data_event(header: Mapping[str, Any], digest: str, decided: Any) -> Iterator[Event]:
    before = header["data_digest"]
    if digest == before:
        return
    data_name = _short_digest(digest)
    if decided is None:
        raise TrilightError(
            f"resume: the data are {data_name}, but the checkpoint was made with "
            f"{_short_digest(before)}. Go on with those by --data, or decide to go on with these "
            f"by --change {DATA}={data_name}, which the run records."
        )
    digits = str(decided).rpartition(":")[2]
    if not _with_prefix(digest).startswith(str(decided)) or len(digits) < _LEAST_DIGITS:
        raise TrilightError(
            f"--change {DATA} is {decided}, but the data are {data_name}; expected that, or the "
            "other data by --data."
        )
    yield Event(step=header["step"], kind="meaning", name=DATA, before=before, after=digest)


def _undecided_error(old: Mapping[str, Any], wrong: Mapping[str, Any]) -> TrilightError:
    """Return the error that lists settings that differ without a decision."""
    said = ", and ".join(
        f"{name} is {_to_text(value)}, but the checkpoint was made with {_to_text(old[name])}"
        for name, value in wrong.items()
    )
    back = " ".join(f"--set {name}={_to_text(old[name])}" for name in wrong)
    if "num_steps" in wrong:
        back += " (and no --steps)"
    if fixed := [name for name in wrong if name.split(".")[0] in _FIXED]:
        other = f"begin another run in another folder, since {fixed[0]} is the run's for good"
    else:
        change = " ".join(f"--change {name}={_to_text(value)}" for name, value in wrong.items())
        other = f"decide on {change}, which the run records"
    return TrilightError(f"resume: {said}. Go on as it was with {back}, or {other}.")


def _require_possible(
    before: TrainSettings, now: TrainSettings, step: int, events: Sequence[Event]
) -> None:
    for event in events:
        if event.kind == "meaning" and event.name.split(".")[0] in _FIXED:
            raise TrilightError(
                f"--change {event.name}: it is the run's for good; expected another run in another "
                "folder, which may begin with this one's weights (--from)."
            )
    if (before.muon_rate == 0) != (now.muon_rate == 0):
        raise TrilightError(
            f"--change muon_rate={now.muon_rate:g}: the checkpoint lacks the memories of the other "
            "optimiser; expected another run in another folder, which begins with this one's "
            "weights (--from)."
        )
    if now.num_steps < step and now.num_steps != before.num_steps:
        raise TrilightError(
            f"--change num_steps={now.num_steps}: {step} steps are done; expected at least that, "
            "or an earlier checkpoint in another folder (--branch)."
        )


def _notes(
    before: TrainSettings,
    now: TrainSettings,
    step: int,
    past: Sequence[Event],
    events: Sequence[Event],
) -> Iterator[str]:
    def value(event: Event, which: Any) -> str:
        return _short_digest(which) if event.name == DATA else _to_text(which)

    standing = {event.name: event for event in past if event.kind == "meaning"}
    for event in standing.values():
        if event.name not in {other.name for other in events}:
            yield f"as decided at step {event.step}, {event.name} is {value(event, event.after)}"
    for event in events:
        said = f"{event.name} is {value(event, event.after)}"
        if event.kind == "earlier":
            yield (
                f"{said} and not {_to_text(event.before)}, since the run is older than that "
                f"setting; --change {event.name}={_to_text(event.before)} changes it"
            )
        else:
            yield f"from step {step} on, {said} instead of {value(event, event.before)}"
    begins = decay_start_step(before)
    if now.num_steps > before.num_steps and begins is not None and begins < step:
        yield (
            f"the rate had been falling since step {begins} and rises again; from the checkpoint "
            f"of that step (--branch), it would be as if the run had been longer all along"
        )


def _to_text(value: Any) -> str:
    """Return a value as it is typed after `=`."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def _with_prefix(digest: str) -> str:
    return digest if ":" in digest else f"sha256:{digest}"


def _short_digest(digest: str) -> str:
    """Return the first 12 digits of a digest of data, after its kind."""
    kind, _, digits = _with_prefix(digest).partition(":")
    return f"{kind}:{digits[:12]}"

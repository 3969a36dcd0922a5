"""How a run goes on: as it was begun, with what was decided since, executed as it is asked now.

A command that resumes states the run as it was begun. What it says of execution is taken as it is.
What it says of meaning has to be what the checkpoint was made with, but for the decisions that were
named for it (`--change`), each of which the run records.
"""

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from storage.errors import TrilightError
from storage.settings.changes import changed, differences
from storage.settings.described import described, from_record, settings_record
from train.loop.schedule import decay_begins
from train.settings import TrainSettings
from train.stored_settings import known_settings

DATA = "data"
"""Name by which a decision names other data; its value is the start of their digest, behind
`sha256:` for a dataset and `list:` for listed shards, so that no digits pass for a number."""

_FIXED = ("run", "from_weights", "model", "base_widths")
"""Settings that no decision changes: with others it would be another run."""

_LEAST_DIGITS = 8
"""So many of a digest name data; fewer could be those of others."""

_EXECUTION = frozenset(field.name for field in described(TrainSettings) if field.is_execution)


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened to a run beside its steps."""

    step: int
    """Steps that were done then."""
    kind: Literal["origin", "meaning", "execution", "earlier"]
    """`origin`: what it began with; `meaning`: a decision; `execution`: it is executed otherwise;
    `earlier`: the run is older than a setting, and stays as it was (`after`), whatever the command
    says (`before`)."""
    name: str
    """The setting; `data`, `processes` or `threads`; of an origin, `weights` or `checkpoint`."""
    before: Any = None
    """Its value until then."""
    after: Any = None
    """Its value since; of an origin the run, its step, and the sha256 of what was taken over."""


@dataclass(frozen=True, kw_only=True)
class GoingOn:
    """A run that goes on."""

    settings: TrainSettings
    """Of the next step."""
    history: tuple[Event, ...]
    """What happened so far, what has just been decided included."""
    notes: tuple[str, ...]
    """What its user should know."""
    has_decided: bool
    """Whether its meaning has just changed."""


def going_on(
    header: Mapping[str, Any],
    typed: TrainSettings,
    data_digest: str,
    decisions: Mapping[str, Any],
) -> GoingOn:
    """Return how a run goes on from a checkpoint.

    Args:
        header: of the checkpoint (train.loop.checkpoints).
        typed: the run as the command states it, as it was begun or as it is now.
        data_digest: of the data that is given.
        decisions: settings by dotted name, and `data`, that are to change from here on.

    Raises:
        TrilightError: settings or data that differ and are no decision; all are named, with both
            values and both ways on. A decision that no run can take, or one of execution.
    """
    step = header["step"]
    before = from_record(TrainSettings, known_settings(header["settings"], "checkpoint"))
    old, past = settings_record(before), events_of(header.get("history", ()))
    named = {name: value for name, value in decisions.items() if name != DATA}
    _require_meaning(named)
    typed_otherwise = differences(old, settings_record(typed))
    asked = {name: typed_otherwise[name] for name in typed_otherwise if name in _EXECUTION}
    now = changed(before, asked | named)
    new = differences(old, settings_record(now))
    stated = _stated_before(past)
    events, wrong = list[Event](), dict[str, Any]()
    for name, value in typed_otherwise.items():
        if name in new or value in stated.get(name, ()):
            continue
        if _lacks(header["settings"], name):
            event = Event(step=step, kind="earlier", name=name, before=value, after=_at(old, name))
            events.append(event)
        else:
            wrong[name] = value
    if wrong:
        raise _differing(old, wrong)
    events += [
        Event(
            step=step,
            kind="execution" if name in _EXECUTION else "meaning",
            name=name,
            before=_at(old, name),
            after=value,
        )
        for name, value in new.items()
    ]
    events += _of_data(header, data_digest, decisions.get(DATA))
    _require_possible(before, now, step, events)
    return GoingOn(
        settings=now,
        history=(*past, *events),
        notes=tuple(_notes(before, now, step, past, events)),
        has_decided=any(event.kind == "meaning" for event in events),
    )


def events_of(records: Sequence[Mapping[str, Any]]) -> tuple[Event, ...]:
    """Return the events of their records."""
    return tuple(Event(**record) for record in records)


def event_records(events: Sequence[Event]) -> list[dict[str, Any]]:
    """Return events as JSON values, as checkpoints, settings.json and summary.json hold them."""
    return [dataclasses.asdict(event) for event in events]


def _stated_before(past: Sequence[Event]) -> dict[str, list[Any]]:
    """Return by name what a command may say of a setting that has changed: how it was begun."""
    stated: dict[str, list[Any]] = {}
    for event in past:
        values = [event.before, event.after] if event.kind == "earlier" else [event.before]
        stated.setdefault(event.name, values)
    return stated


def _require_meaning(named: Mapping[str, Any]) -> None:
    for name, value in named.items():
        if name in _EXECUTION:
            raise TrilightError(
                f"--change {name}: it is execution, which is free when a run goes on; expected "
                f"--set {name}={_shown(value)}."
            )


def _of_data(header: Mapping[str, Any], digest: str, decided: Any) -> Iterator[Event]:
    before = header["data_digest"]
    if digest == before:
        return
    given = _short(digest)
    if decided is None:
        raise TrilightError(
            f"resume: the data are {given}, but the checkpoint was made with {_short(before)}. Go "
            f"on with those by --data, or decide to go on with these by --change {DATA}={given}, "
            "which the run records."
        )
    digits = str(decided).rpartition(":")[2]
    if not _prefixed(digest).startswith(str(decided)) or len(digits) < _LEAST_DIGITS:
        raise TrilightError(
            f"--change {DATA} is {decided}, but the data are {given}; expected that, or the other "
            "data by --data."
        )
    yield Event(step=header["step"], kind="meaning", name=DATA, before=before, after=digest)


def _differing(old: Mapping[str, Any], wrong: Mapping[str, Any]) -> TrilightError:
    """Return the error for settings that differ and were not decided on."""
    said = ", and ".join(
        f"{name} is {_shown(value)}, but the checkpoint was made with {_shown(_at(old, name))}"
        for name, value in wrong.items()
    )
    back = " ".join(f"--set {name}={_shown(_at(old, name))}" for name in wrong)
    if "num_steps" in wrong:
        back += " (and no --steps)"
    if fixed := [name for name in wrong if name.split(".")[0] in _FIXED]:
        other = f"begin another run in another folder, since {fixed[0]} is the run's for good"
    else:
        change = " ".join(f"--change {name}={_shown(value)}" for name, value in wrong.items())
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
        return _short(which) if event.name == DATA else _shown(which)

    standing = {event.name: event for event in past if event.kind == "meaning"}
    for event in standing.values():
        if event.name not in {other.name for other in events}:
            yield f"as decided at step {event.step}, {event.name} is {value(event, event.after)}"
    for event in events:
        said = f"{event.name} is {value(event, event.after)}"
        if event.kind == "earlier":
            yield (
                f"{said} and not {_shown(event.before)}, since the run is older than that setting; "
                f"--change {event.name}={_shown(event.before)} changes it"
            )
        else:
            yield f"from step {step} on, {said} instead of {value(event, event.before)}"
    begins = decay_begins(before)
    if now.num_steps > before.num_steps and begins is not None and begins < step:
        yield (
            f"the rate had been falling since step {begins} and rises again; from the checkpoint "
            f"of that step (--branch), it would be as if the run had been longer all along"
        )


def _shown(value: Any) -> str:
    """Return a value as a person writes it behind `=`."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))


def _prefixed(digest: str) -> str:
    return digest if ":" in digest else f"sha256:{digest}"


def _short(digest: str) -> str:
    """Return the start of a digest of data, enough to tell them apart."""
    kind, _, digits = _prefixed(digest).partition(":")
    return f"{kind}:{digits[:12]}"


def _at(record: Mapping[str, Any], name: str) -> Any:
    """Return the value of a dotted name."""
    value: Any = record
    for part in name.split("."):
        value = value[part]
    return value


def _lacks(record: Mapping[str, Any], name: str) -> bool:
    try:
        _at(record, name)
    except (KeyError, TypeError):
        return True
    return False

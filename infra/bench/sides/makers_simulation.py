"""A thousand machines that make one dataset, simulated: how long they take, and over what.

Each machine takes tasks of an array, one after the other: it starts, begins, makes shard by shard,
notes each, and looks at the end whether all are there; the last one finishes the dataset. Machines
vanish and are replaced; what theirs had made of a task stays, and the rest is queued again. Scenes
differ in cost as rendered ones do, and some machines are slow.
"""

import math
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from infra.bench.sides.event_simulation import Clock, Steps, Turn, Vanished
from storage.seeds import rng_for

_LEASE_S = 90.0
"""How long the lock of a machine that is gone stays taken: the lease of NFS."""


@dataclass(frozen=True, kw_only=True)
class Growing:
    """Seconds, or requests, of a step as they grow with the dataset."""

    fixed: float = 0.0
    """Of any dataset."""
    planned: float = 0.0
    """For each shard that it will have."""
    made: float = 0.0
    """For each shard that is there."""

    def of(self, planned: int, made: float) -> float:
        """Return the number for so many shards."""
        return self.fixed + self.planned * planned + self.made * made


NOTHING = Growing()


@dataclass(frozen=True, kw_only=True)
class MakerStep:
    """What a maker does at one moment beside making scenes."""

    work_s: Growing = NOTHING
    """All of it."""
    in_turn_s: Growing = NOTHING
    """The part of that which one maker does at a time."""
    requests: Growing = NOTHING
    """To the server of a bucket."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """How makers agree on what is made."""

    start_s: float
    """From the first instruction of a process to its first scene, without `begin`."""
    begin: MakerStep
    """Once for a task, at its beginning."""
    note: MakerStep
    """For each shard."""
    end: MakerStep
    """Once for a task, at its end."""
    finish: MakerStep
    """What the last maker does when every shard is there, alone."""
    keeps_scenes: bool = True
    """Whether the scenes of an unfinished shard outlive the machine, as in a shared folder."""
    requests_a_s: float = math.inf
    """How many requests the server takes a second, from all together."""
    latency_s: float = 0.0
    """Of one request, which waits for the one before."""
    at_once: int = 1
    """Requests that the last maker has on the way at a time, where it fetches notes."""


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """The work, and who does it."""

    machines: int
    """Machines at a time."""
    cores: int = 16
    """Cores of each."""
    num_shards: int = 250_000
    """Shards of the dataset."""
    scenes_per_shard: int = 8
    """Scenes of each."""
    scene_core_s: float = 61.8
    """Core-seconds of a scene (`trilight bench throughput`: 233 views a core-hour, four views)."""
    spread: float = 1.2
    """Standard deviation of the logarithm of a scene's cost: 1.3 of one view of each of the twelve
    scenes of `trilight bench throughput`, at 256 pixels and 46 dB."""
    slow_share: float = 0.02
    """Share of the machines that are slow."""
    slow_by: float = 3.0
    """What a scene takes on these, divided by what it takes on others."""
    life_s: float = 8 * 3600.0
    """Mean life of a machine, which spot markets take away; exponential. Infinite: none is."""
    replaced_s: float = 300.0
    """Until another one is there."""
    cores_together: int = 0
    """Cores that all makers have together for what is not making, where they are processes of one
    machine; 0: each is a machine of its own."""
    shards_per_task: int = 0
    """Shards of a task; 0: so many that a machine has about ten, and a task 40 or fewer."""

    @property
    def task_shards(self) -> int:
        """Shards of a task."""
        return self.shards_per_task or max(1, min(40, self.num_shards // (10 * self.machines)))

    @property
    def ideal_s(self) -> float:
        """Seconds of scenes alone, shared equally by machines that are never slow nor taken."""
        scenes = self.num_shards * self.scenes_per_shard
        return scenes * self.scene_core_s / self.cores / self.machines


@dataclass(kw_only=True)
class Fate:
    """What became of a simulated dataset."""

    seconds: float
    """Until it was finished."""
    spent_s: dict[str, float]
    """Machine-seconds by what they went to."""
    vanished: int
    """Machines that were taken away."""

    def shares(self) -> dict[str, float]:
        """Return the share of the machine-seconds by what they went to."""
        total = sum(self.spent_s.values())
        return {name: seconds / total for name, seconds in self.spent_s.items()}


MAKING, STARTING, WAITING, OWN_STEPS, LOST, IDLE, FINISHING = (
    "making scenes", "starting", "waiting for a turn", "begin, note and end", "made twice",
    "idle", "finishing",
)  # fmt: skip


def simulated(fleet: Fleet, protocol: Protocol, *, seed: int = 0) -> Fate:
    """Return how a fleet fares; equal for equal arguments."""
    return _Making(fleet, protocol, seed).run()


@dataclass(eq=False)
class _Task:
    shards: deque[float]  # what is left: machine-seconds of each shard


class _Making:
    def __init__(self, fleet: Fleet, protocol: Protocol, seed: int) -> None:
        self._fleet, self._protocol = fleet, protocol
        self._rng = rng_for(seed, "makers", fleet.machines)
        self._clock = Clock()
        self._turn, self._server = Turn(self._clock), Turn(self._clock)
        self._cores = Turn(self._clock, fleet.cores_together) if fleet.cores_together else None
        self._spent: defaultdict[str, float] = defaultdict(float)
        self._done = self._vanished = 0
        each = _shard_seconds(fleet, self._rng)
        size = fleet.task_shards
        self._tasks = deque(_Task(deque(each[at : at + size])) for at in range(0, len(each), size))
        self._last_s = 0.0

    def run(self) -> Fate:
        fleet = self._fleet
        for _ in range(fleet.machines):
            self._machine(after_s=0.0)
        self._clock.run()
        finishing_s = self._finishing_s()
        seconds = self._last_s + finishing_s
        spent = dict(self._spent)
        spent[FINISHING] = finishing_s
        spent[IDLE] = max(0.0, fleet.machines * seconds - sum(spent.values()))
        return Fate(seconds=seconds, spent_s=spent, vanished=self._vanished)

    def _finishing_s(self) -> float:
        protocol, planned = self._protocol, self._fleet.num_shards
        requests = protocol.finish.requests.of(planned, planned)
        answered_s = requests * max(
            protocol.latency_s / protocol.at_once, 1 / protocol.requests_a_s
        )
        return protocol.finish.work_s.of(planned, planned) + answered_s

    def _machine(self, *, after_s: float) -> None:
        fleet = self._fleet
        slow = fleet.slow_by if self._rng.random() < fleet.slow_share else 1.0
        lasts_s = (
            float(self._rng.exponential(fleet.life_s)) if fleet.life_s < math.inf else math.inf
        )
        self._clock.start(self._life(slow), after_s=after_s, lasts_s=lasts_s)

    def _life(self, slow: float) -> Steps:
        while self._tasks:
            task = self._tasks.popleft()
            try:
                yield from self._run(task, slow)
            except Vanished:
                self._vanished += 1
                if task.shards:
                    self._tasks.append(task)
                self._machine(after_s=self._fleet.replaced_s)
                raise
            self._last_s = self._clock.now

    def _run(self, task: _Task, slow: float) -> Steps:
        protocol = self._protocol
        yield from self._spend(STARTING, protocol.start_s)
        yield from self._step(protocol.begin)
        while task.shards:
            yield from self._make(task, slow)
            yield from self._step(protocol.note)
        yield from self._step(protocol.end)

    def _make(self, task: _Task, slow: float) -> Steps:
        began, takes_s = self._clock.now, task.shards[0] * slow
        try:
            yield takes_s
        except Vanished:
            worked_s, scene_s = self._clock.now - began, takes_s / self._fleet.scenes_per_shard
            lost_s = worked_s % scene_s if self._protocol.keeps_scenes else worked_s
            self._spent[LOST] += lost_s
            self._spent[MAKING] += worked_s - lost_s
            task.shards[0] -= (worked_s - lost_s) / slow
            raise
        self._spent[MAKING] += takes_s
        task.shards.popleft()
        self._done += 1

    def _step(self, step: MakerStep) -> Steps:
        protocol, planned = self._protocol, self._fleet.num_shards

        def now(grows: Growing) -> float:
            return grows.of(planned, self._done)

        alone_s = max(0.0, now(step.work_s) - now(step.in_turn_s))
        requests = now(step.requests)
        if step.in_turn_s != NOTHING:
            yield from self._in(self._turn, lambda: now(step.in_turn_s), kept_s=_LEASE_S)
        if self._cores is None:
            yield from self._spend(OWN_STEPS, alone_s)
        else:
            yield from self._in(self._cores, lambda: alone_s, kept_s=0.0)
        if requests:
            yield from self._spend(OWN_STEPS, requests * protocol.latency_s)
            server_s = requests / protocol.requests_a_s
            yield from self._in(self._server, lambda: server_s, kept_s=0.0)

    def _in(self, turn: Turn, seconds: Callable[[], float], *, kept_s: float) -> Steps:
        asked, held_s = self._clock.now, 0.0

        def wanted() -> float:
            nonlocal held_s
            held_s = seconds()
            return held_s

        try:
            yield from turn.held(wanted, kept_s=kept_s)
        finally:
            taken_s = self._clock.now - asked
            self._spent[OWN_STEPS] += min(held_s, taken_s)
            self._spent[WAITING] += max(0.0, taken_s - held_s)

    def _spend(self, what: str, seconds: float) -> Steps:
        began = self._clock.now
        try:
            yield seconds
        finally:
            self._spent[what] += self._clock.now - began


def _shard_seconds(fleet: Fleet, rng: np.random.Generator) -> Sequence[float]:
    """Return the machine-seconds of every shard, which together are those of the mean scene."""
    scenes = np.full(fleet.num_shards, 0.0)
    for _ in range(fleet.scenes_per_shard):
        scenes += rng.lognormal(0.0, fleet.spread, fleet.num_shards)
    mean = scenes.mean()
    total_s = fleet.scene_core_s / fleet.cores * fleet.scenes_per_shard
    return [float(value) for value in scenes * (total_s / mean)]

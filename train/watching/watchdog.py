"""Notices a step that does not end, and says where every process is while it still does not."""

import faulthandler
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from storage.errors import TrilightError
from train.loop.crew import Crew
from train.watching.activity import PARTS, Activity
from train.watching.settings import WatchSettings

KNOWN = 3
"""Number of stretches of a kind after which their usual time is known."""

UNKNOWN_FACTOR = 5.0
"""How much longer than `hang_after_s` a stretch may take whose usual time is not known."""

POLL_S = 1.0
"""How often the watching thread looks, unless `hang_after_s` is shorter than a few of these."""

MOST_FILES = 50
"""Files of stacks that one process writes; later hangs are only told."""

GRACE_S = 5.0
"""How long a run that is to stop waits for what the other processes write."""


@dataclass(frozen=True, kw_only=True)
class _Stretch:
    """A step, a validation or a saving that is under way."""

    kind: str
    step: int
    since_s: float
    usual_s: float | None
    limit_s: float

    @property
    def name(self) -> str:
        """What it is called for people."""
        if self.kind == "step":
            return f"step {self.step}"
        return f"the {self.kind} after step {self.step}"


@dataclass(kw_only=True)
class _Hang:
    """A stretch that hangs, and what was said of it."""

    stretch: _Stretch
    began_s: float
    next_s: float
    """When to speak again."""
    spoken: bool = False
    """Whether this process has told of it."""
    stopped: bool = False
    """Whether the run was told to stop."""
    told: set[Path] = field(default_factory=set)
    """Files of other processes whose first line was passed on."""


class Watchdog:
    """Watches the stretches of a training from a thread of its own, in every process.

    The first process tells the user; the others write files beside the stacks, of which the first
    one tells the opening line. A thread that holds Python's lock in native code is not seen.
    """

    def __init__(
        self,
        settings: WatchSettings,
        activity: Activity,
        crew: Crew,
        folder: Path,
        *,
        noted: Callable[[str], None],
        hung: Callable[[str], None],
    ) -> None:
        """Take what to watch.

        Args:
            settings: from when on a stretch hangs, and what to do then.
            activity: what the process does.
            crew: the processes.
            folder: for the files.
            noted: is told of a hang, in the thread of the watchdog.
            hung: is told of one if the run is to stop, after GRACE_S.
        """
        self._settings, self._activity, self._crew = settings, activity, crew
        self._folder, self._hung = folder, hung
        self._told = noted
        self._usual_s: dict[str, deque[float]] = {}
        self._stretch: _Stretch | None = None
        self._closed = threading.Event()
        self._files = 0
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def __enter__(self) -> "Watchdog":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._thread.join()

    def begins(self, kind: str, step: int) -> None:
        """End the stretch that is under way, and begin another.

        Args:
            kind: those of one kind take about the same time.
            step: the step that it belongs to, from 1.
        """
        now_s, before = time.monotonic(), self._stretch
        if before is not None:
            known = self._usual_s.setdefault(before.kind, deque(maxlen=100))
            known.append(now_s - before.since_s)
        known = self._usual_s.get(kind, deque())
        usual_s = statistics.median(known) if len(known) >= KNOWN else None
        self._stretch = _Stretch(
            kind=kind, step=step, since_s=now_s, usual_s=usual_s, limit_s=self._limit_s(usual_s)
        )

    def _limit_s(self, usual_s: float | None) -> float:
        least_s = self._settings.hang_after_s
        if usual_s is None:
            return UNKNOWN_FACTOR * least_s
        return max(least_s, self._settings.hang_factor * usual_s)

    def _watch(self) -> None:
        hang: _Hang | None = None
        while not self._closed.wait(min(POLL_S, self._settings.hang_after_s / 5)):
            now_s, stretch = time.monotonic(), self._stretch
            if hang is not None and stretch is not hang.stretch:
                self._noted(f"{hang.stretch.name} went on after all")
                hang = None
            if stretch is None or now_s - stretch.since_s < stretch.limit_s:
                continue
            if hang is None:
                hang = _Hang(stretch=stretch, began_s=now_s, next_s=now_s)
                self._files += 1
            if now_s >= hang.next_s:
                hang.next_s = stretch.since_s + 2 * (now_s - stretch.since_s)  # ever more rarely
                self._tell(hang, now_s)
            if self._crew.is_first:
                self._pass_on(hang, now_s)
                self._stop_if_asked(hang, now_s)

    def _tell(self, hang: _Hang, now_s: float) -> None:
        """Write the stacks, and say in which part this process is."""
        stretch, doing = hang.stretch, self._activity.now
        path = self._path(stretch.step, self._crew.rank)
        usual = "" if stretch.usual_s is None else f", where {stretch.usual_s:.2g} s is usual"
        line = (
            f"process {self._crew.rank} of {self._crew.world_size}: {stretch.name} "
            f"has taken {now_s - stretch.since_s:.1f} s{usual}; for "
            f"{now_s - doing.since_s:.1f} s it has been in: {PARTS[doing.part]}"
        )
        written = ""
        if self._files <= MOST_FILES:
            with suppress(OSError):
                _write_stacks(path, line, again=hang.spoken)
                written = f". Stacks of its threads: {path}"
        hang.spoken = True
        self._noted(line + written)

    def _noted(self, text: str) -> None:
        with suppress(TrilightError):  # a full disk is no reason to end a thread that only watches
            self._told(text)

    def _path(self, step: int, rank: int | str) -> Path:
        return self._folder / f"hang-step-{step:09d}-rank-{rank}.txt"

    def _pass_on(self, hang: _Hang, now_s: float) -> None:
        """Tell what the other processes wrote of the same step, in this call of the trainer."""
        began_unix_s = time.time() - (now_s - hang.stretch.since_s)
        hang.told.add(self._path(hang.stretch.step, self._crew.rank))
        pattern = self._path(hang.stretch.step, "*").name
        for path in sorted(set(self._folder.glob(pattern)) - hang.told):
            with suppress(OSError):
                lines = path.read_text().splitlines()
                if lines and path.stat().st_mtime >= began_unix_s:
                    hang.told.add(path)
                    self._noted(f"{lines[0]}. Stacks of its threads: {path}")

    def _stop_if_asked(self, hang: _Hang, now_s: float) -> None:
        asked = self._settings.on_hang == "stop" and not hang.stopped
        if asked and now_s - hang.began_s >= GRACE_S:
            hang.stopped = True
            self._hung(f"training: {hang.stretch.name} hangs, and the run was asked to stop then")


def _write_stacks(path: Path, line: str, *, again: bool) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a" if again else "w") as stream:
        stream.write(f"{line}\n\n")
        stream.flush()
        faulthandler.dump_traceback(stream, all_threads=True)
        stream.write("\n")

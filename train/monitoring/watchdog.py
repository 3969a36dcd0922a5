"""Watchdog that detects hung steps and reports the stacks of every process."""

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
from train.loop.distributed import DistributedContext
from train.monitoring.process_monitor import PHASES, Activity
from train.settings import WatchSettings

MIN_SAMPLES = 3
"""Number of measured sections of a kind from which their usual time is known."""

UNKNOWN_FACTOR = 5.0
"""Multiple of `hang_after_s` after which a section without a known usual time counts as hung."""

POLL_S = 1.0
"""Interval of the watchdog's checks; shorter if `hang_after_s` is only a few of these."""

MAX_FILES = 50
"""Maximum number of stack files of one process; later hangs are only reported."""

GRACE_S = 5.0
"""Time that a run waits for the other processes' files before it stops on a hang."""


@dataclass(kw_only=True, eq=False)
class _Stretch:
    """A step, validation or saving in progress, and what was reported if it hangs."""

    kind: str
    step: int
    since_s: float
    usual_s: float | None
    limit_s: float
    hung_s: float | None = None
    """time.monotonic() at which it was seen to hang; None if it does not."""
    next_s: float = 0.0
    """time.monotonic() of the next report."""
    is_reported: bool = False
    """True after this process has reported the hang."""
    is_stopped: bool = False
    """True after the run was asked to stop."""
    passed_on: set[Path] = field(default_factory=set)
    """Stack files of other processes whose first line was already reported."""

    @property
    def name(self) -> str:
        """Display name in messages."""
        if self.kind == "step":
            return f"step {self.step}"
        return f"the {self.kind} after step {self.step}"


class Watchdog:
    """Monitors the duration of steps, validations and savings from a thread, in every process.

    Every process writes its stacks to a file; the first process reports the first line of each to
    the user. A hang in native code that holds Python's lock is not detected.
    """

    def __init__(
        self,
        settings: WatchSettings,
        activity: Activity,
        dist_context: DistributedContext,
        folder: Path,
        *,
        note: Callable[[str], None],
        report_hang: Callable[[str], None],
    ) -> None:
        """Create the watchdog.

        Args:
            note: called with a message about a hang, in the watchdog's thread.
            report_hang: called GRACE_S after a hang if the run is to stop on one.
        """
        self._settings = settings
        self._activity = activity
        self._dist_context = dist_context
        self._folder = folder
        self._report_hang = report_hang
        self._note = note
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

    def begin(self, kind: str, step: int) -> None:
        """End the current section, and begin another.

        Args:
            kind: kind of the section; sections of one kind take about the same time.
            step: step that the section belongs to, from 1.
        """
        now_s = time.monotonic()
        before = self._stretch
        if before is not None:
            known = self._usual_s.setdefault(before.kind, deque(maxlen=100))
            known.append(now_s - before.since_s)
        known = self._usual_s.get(kind, deque())
        usual_s = statistics.median(known) if len(known) >= MIN_SAMPLES else None
        limit_s = UNKNOWN_FACTOR * self._settings.hang_after_s
        if usual_s is not None:
            limit_s = max(self._settings.hang_after_s, self._settings.hang_factor * usual_s)
        self._stretch = _Stretch(
            kind=kind, step=step, since_s=now_s, usual_s=usual_s, limit_s=limit_s
        )

    def _watch(self) -> None:
        hang: _Stretch | None = None
        while not self._closed.wait(min(POLL_S, self._settings.hang_after_s / 5)):
            now_s = time.monotonic()
            stretch = self._stretch
            if hang is not None and stretch is not hang:
                self._note_safely(f"{hang.name} went on after all")
                hang = None
            if stretch is None or now_s - stretch.since_s < stretch.limit_s:
                continue
            hang = stretch
            if hang.hung_s is None:
                hang.hung_s = now_s
                self._files += 1
            if now_s >= hang.next_s:
                hang.next_s = hang.since_s + 2 * (now_s - hang.since_s)  # ever more rarely
                self._report(hang, now_s)
            if self._dist_context.is_first:
                self._forward_reports(hang, now_s)
                should_stop = self._settings.on_hang == "stop" and not hang.is_stopped
                if should_stop and now_s - hang.hung_s >= GRACE_S:
                    hang.is_stopped = True
                    self._report_hang(
                        f"training: {hang.name} hangs, and the run was asked to stop then"
                    )

    def _report(self, stretch: _Stretch, now_s: float) -> None:
        """Write the stacks, and report the current phase of this process."""
        doing = self._activity.now
        path = self._path(stretch.step, self._dist_context.rank)
        usual = "" if stretch.usual_s is None else f", where {stretch.usual_s:.2g} s is usual"
        line = (
            f"process {self._dist_context.rank} of {self._dist_context.world_size}: {stretch.name} "
            f"has taken {now_s - stretch.since_s:.1f} s{usual}; for "
            f"{now_s - doing.since_s:.1f} s it has been in: {PHASES[doing.phase]}"
        )
        written = ""
        if self._files <= MAX_FILES:
            with suppress(OSError):
                _write_stacks(path, line, appends=stretch.is_reported)
                written = f". Stacks of its threads: {path}"
        stretch.is_reported = True
        self._note_safely(line + written)

    def _note_safely(self, text: str) -> None:
        with suppress(TrilightError):  # a full disk must not end the watchdog
            self._note(text)

    def _path(self, step: int, rank: int | str) -> Path:
        return self._folder / f"hang-step-{step:09d}-rank-{rank}.txt"

    def _forward_reports(self, hang: _Stretch, now_s: float) -> None:
        """Report new stack files of the other processes about the same step."""
        began_unix_s = time.time() - (now_s - hang.since_s)
        hang.passed_on.add(self._path(hang.step, self._dist_context.rank))
        pattern = self._path(hang.step, "*").name
        for path in sorted(set(self._folder.glob(pattern)) - hang.passed_on):
            with suppress(OSError):
                lines = path.read_text().splitlines()
                if lines and path.stat().st_mtime >= began_unix_s:
                    hang.passed_on.add(path)
                    self._note_safely(f"{lines[0]}. Stacks of its threads: {path}")


def _write_stacks(path: Path, line: str, *, appends: bool) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a" if appends else "w") as stream:
        stream.write(f"{line}\n\n")
        stream.flush()
        faulthandler.dump_traceback(stream, all_threads=True)
        stream.write("\n")

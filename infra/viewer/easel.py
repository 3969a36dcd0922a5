"""One picture at a time: whoever asks for another gives up the one that is being made.

A finished picture is kept for a while, so that switching back to it costs nothing. Pictures of one
scene, camera and width are judged against the best of them: the file's own, else the path traced
one.
"""

import itertools
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from infra.viewer.edits import edited
from infra.viewer.painters import Painted, Painter
from infra.viewer.wanted import Wanted
from pipeline.renders.results import Sampling
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.scene import Scene

MOST_KEPT = 32
"""Pictures that are kept; one of 1024 pixels takes 13 MB."""

PATIENCE_S = 20.0
"""How long an answer waits for something new."""

LAST_PICTURE_S = 15.0
"""How long the end waits for the picture at hand."""

_TRUTHS = ("target", "traced")

State = Literal["waiting", "working", "done", "failed", "cancelled"]


class _Superseded(Exception):
    """Nobody wants the picture at hand any more."""


@dataclass(kw_only=True, eq=False)
class Job:
    """A picture that was asked for."""

    id: str
    wanted: Wanted
    state: State = "waiting"
    version: int = 0
    """Grows with everything new."""
    painted: Painted | None = None
    sampling: Sampling | None = None
    """How far a tracer is since the picture was shown last."""
    error: str = ""
    prices: list[Mapping[str, float | int | None]] = field(default_factory=list)
    """Samples, core-seconds and stated error of each state so far."""


class Easel:
    """Makes the pictures of one scene."""

    def __init__(self, scene: Scene, painters: Mapping[str, Painter]) -> None:
        self._scene = scene
        self._painters = painters
        self._news = threading.Condition()
        self._jobs = OrderedDict[str, Job]()
        self._next: Job | None = None
        self._thread: threading.Thread | None = None
        self._numbers = itertools.count(1)
        self._edited: tuple[str, Scene] | None = None
        self._closed = False

    def ask(self, wanted: Wanted) -> Job:
        """Begin a picture, or return the one that is there; what was being made is given up."""
        with self._news:
            same = [job for job in self._jobs.values() if _is_same(job, wanted)]
            if same:
                self._jobs.move_to_end(same[-1].id)
                return same[-1]
            job = Job(id=str(next(self._numbers)), wanted=wanted)
            self._jobs[job.id] = job
            self._give_up(self._next)
            self._next = job
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, daemon=True)
                self._thread.start()
            self._news.notify_all()
            return job

    def rest(self) -> None:
        """Give up what is being made and wanted."""
        with self._news:
            self._give_up(self._next)
            self._next = None
            for job in self._jobs.values():
                if job.state == "working":
                    self._tell(job, state="cancelled")

    def job(self, number: str) -> Job:
        """Return a job by its id; raises TrilightError where it is gone."""
        with self._news:
            if number not in self._jobs:
                raise TrilightError("The picture is not kept any more; ask for it again.")
            return self._jobs[number]

    def news(self, number: str, after: int) -> Job:
        """Return a job once it is newer than a version, or after a while."""
        job = self.job(number)
        with self._news:
            self._news.wait_for(lambda: job.version > after or _is_over(job), PATIENCE_S)
        return job

    def truth(self, job: Job) -> Job | None:
        """Return the picture that another one is judged against; None where there is none yet."""
        with self._news:
            for engine in _TRUTHS:
                for other in reversed(self._jobs.values()):
                    if _can_judge(other, job, engine):
                        return other
        return None

    def scene(self, wanted_key: str, edits: Mapping[str, Any]) -> Scene:
        """Return the scene with changes; the last one is kept."""
        if self._edited is None or self._edited[0] != wanted_key:
            self._edited = (wanted_key, edited(self._scene, edits))
        return self._edited[1]

    def close(self) -> None:
        """End the thread with the picture at hand."""
        with self._news:
            self._closed = True
            self._news.notify_all()

    def join(self) -> None:
        """Wait for the picture at hand, which `close` ends at its next step.

        A process that ends while libraries work in a thread of it is aborted by them.
        """
        if self._thread is not None:
            self._thread.join(LAST_PICTURE_S)

    def _work(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._next is not None or self._closed)
                job = self._next
                self._next = None
                if job is None or self._closed:
                    return
                self._tell(job, state="working")
            self._paint(job)

    def _paint(self, job: Job) -> None:
        def show(step: Painted | Sampling) -> None:
            with self._news:
                if self._next is not None or self._closed or job.state != "working":
                    raise _Superseded
                if isinstance(step, Painted):
                    job.painted = step
                    job.sampling = None
                    job.prices.append(
                        {"spp": step.spp, "core_s": step.core_s, "floor_db": step.floor_db}
                    )
                else:
                    job.sampling = step
                self._tell(job)

        state = "done"
        error = ""
        try:
            scene = self.scene(job.wanted.scene_key, job.wanted.edits)
            self._painters[job.wanted.engine].paint(scene, job.wanted, show)
        except _Superseded:
            state = "cancelled"
        except TrilightError as mistake:
            state = "failed"
            error = str(mistake)
        except Exception as defect:  # of any library: the page says so, and the next picture comes
            state = "failed"
            error = f"{type(defect).__name__}: {defect}"
        with self._news:
            job.error = error
            self._tell(job, state=state)
            while len(self._jobs) > MOST_KEPT:
                self._jobs.popitem(last=False)

    def _give_up(self, job: Job | None) -> None:
        if job is not None:
            self._tell(job, state="cancelled")

    def _tell(self, job: Job, *, state: State | str | None = None) -> None:
        job.state = state or job.state  # type: ignore[assignment]
        job.version += 1
        self._news.notify_all()


def agreement_db(job: Job, truth: Job | None) -> float | None:
    """Return psnr_log_db of a picture against another one; None where one is missing."""
    if truth is None or truth is job or job.painted is None or truth.painted is None:
        return None
    mine = job.painted.radiance_rgb
    other = truth.painted.radiance_rgb
    if mine is None or other is None or mine.shape != other.shape:
        return None
    return float(psnr_log_db(mine, other))


def _is_over(job: Job) -> bool:
    return job.state in ("done", "failed", "cancelled")


def _is_same(job: Job, wanted: Wanted) -> bool:
    return (
        job.state in ("waiting", "working", "done")
        and job.wanted.engine == wanted.engine
        and job.wanted.place_key == wanted.place_key
        and job.wanted.error_db == wanted.error_db
    )


def _can_judge(other: Job, job: Job, engine: str) -> bool:
    mine = job.painted
    its = other.painted
    return (
        other.wanted.engine == engine
        and other is not job
        and other.wanted.place_key == job.wanted.place_key
        and its is not None
        and its.radiance_rgb is not None
        and (engine == "target" or its.floor_db is not None)
        and (
            mine is None
            or mine.radiance_rgb is None
            or mine.radiance_rgb.shape == its.radiance_rgb.shape
        )
    )

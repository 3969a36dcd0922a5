"""Background thread that writes checkpoints, so that a slow disk does not delay steps."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from storage.errors import TrilightError


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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.wait()
        except TrilightError as failed:
            if error is None:
                raise
            error.add_note(str(failed))
        finally:
            self._pool.shutdown()

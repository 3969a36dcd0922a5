"""A stand-in for a child process that runs its calls here: imports and kernels are paid once."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from infra.render import path_tracer
from pipeline.exchange import reader
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, Reach, Result
from pipeline.isolation.answers import decode_answer, encode_result
from storage.errors import Rejected, TrilightError


class ChildHere:
    """Has the calls of `pipeline.isolation.IsolatedChild`, and neither limits nor a process."""

    def __init__(
        self,
        *,
        limits: ChildLimits,
        factory: Callable[..., object] | None = None,
        args: tuple[Any, ...] = (),
        confined_to: Reach | None = None,
        writes: Iterable[Path] = (),
    ) -> None:
        self._factory = factory
        self._args = args
        self._held: object = None

    def allow_files(self, more: Reach) -> None:
        """Allow more files: nothing is confined here."""

    def call(self, function: Callable[..., Result], *args: Any) -> Result:
        """Run a function; what it raises ends the call as it would in a child."""
        try:
            self._make()
            # as between processes: an answer of another type than declared is a failure
            answer = [
                np.frombuffer(part, np.uint8).copy() for part in encode_result(function(*args))
            ]
            return cast(Result, decode_answer(answer, function))
        except (Rejected, TrilightError):
            raise
        except Exception as error:
            raise ChildFailed("exception", f"{type(error).__name__}: {error}") from error

    def call_method(self, method: Callable[..., Result], *args: Any) -> Result:
        """Run a function whose first argument is the object that the factory made."""
        self._make()
        return self.call(method, self._held, *args)

    def _make(self) -> None:
        if self._factory is not None:
            self._held = self._factory(*self._args)
            self._factory = None

    def retire(self) -> None:
        """End nothing."""

    def close(self) -> None:
        """End nothing."""


_CALLERS = (reader, path_tracer)


def use_children_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have scenes read, converted and path traced in this process."""
    for module in _CALLERS:
        monkeypatch.setattr(module, "IsolatedChild", ChildHere)


def use_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have them read, converted and path traced in child processes again, as for a user."""
    for module in _CALLERS:
        monkeypatch.setattr(module, "IsolatedChild", IsolatedChild)

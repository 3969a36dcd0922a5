"""A law over many values as one test: an item for each costs more than most of the laws."""

import contextlib
import functools
import inspect
import reprlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

Test = Callable[..., None]


def for_each(names: str | Sequence[str], values: Iterable[Any]) -> Callable[[Test], Test]:
    """Run a test once for each value, in one item; a failure names its value.

    The arguments are those of `pytest.mark.parametrize`. Each value has a `tmp_path` of its own,
    and what it changed by `monkeypatch` is undone.
    """
    words = [word.strip() for word in names.split(",")] if isinstance(names, str) else list(names)
    rows = [value if len(words) > 1 else (value,) for value in values]

    def of_all(test: Test) -> Test:
        signature = inspect.signature(test)
        fixtures = [each for name, each in signature.parameters.items() if name not in words]

        @functools.wraps(test)
        def run(**given: Any) -> None:
            for number, row in enumerate(rows):
                named = dict(zip(words, row, strict=True))
                with contextlib.ExitStack() as stack:
                    try:
                        test(**_own(given, number, stack), **named)
                    except BaseException as error:
                        error.add_note(f"where {_listed(named)}")
                        raise

        run.__signature__ = signature.replace(parameters=fixtures)  # type: ignore[attr-defined]
        return run

    return of_all


def _own(given: dict[str, Any], number: int, stack: contextlib.ExitStack) -> dict[str, Any]:
    """Return the fixtures of one value."""
    own = dict(given)
    if "tmp_path" in given:
        own["tmp_path"] = Path(given["tmp_path"]) / f"value-{number}"
        own["tmp_path"].mkdir()
    if "monkeypatch" in given:
        patch: pytest.MonkeyPatch = given["monkeypatch"]
        own["monkeypatch"] = stack.enter_context(patch.context())
    return own


def _listed(named: dict[str, Any]) -> str:
    return ", ".join(f"{name} is {reprlib.repr(value)}" for name, value in named.items())

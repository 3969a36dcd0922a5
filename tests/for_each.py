"""Many values of one law in one test: an item for each costs more than most of the laws.

`for_each` decorates a test, `case` names one round of a loop; a failure names its value either way.
"""

import contextlib
import functools
import inspect
import reprlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

Test = Callable[..., None]


@contextlib.contextmanager
def case(name: object) -> Iterator[None]:
    """Add the name of a case to whatever fails inside."""
    try:
        yield
    except BaseException as failure:
        failure.add_note(f"in the case {name!r}")
        raise


def for_each(names: str | Sequence[str], values: Iterable[Any]) -> Callable[[Test], Test]:
    """Run a test once for each value, in one item.

    The arguments are those of `pytest.mark.parametrize`. Each value has an empty `tmp_path`, and
    what it changed by `monkeypatch` is undone.
    """
    words = [word.strip() for word in names.split(",")] if isinstance(names, str) else list(names)
    rows = [value if len(words) > 1 else (value,) for value in values]
    assert rows, "no values: the test would pass without a run"

    def decorate(test: Test) -> Test:
        signature = inspect.signature(test)
        fixtures = [each for name, each in signature.parameters.items() if name not in words]

        @functools.wraps(test)
        def run(**given: Any) -> None:
            for number, row in enumerate(rows):
                arguments = dict(zip(words, row, strict=True))
                name = ", ".join(f"{key}={reprlib.repr(each)}" for key, each in arguments.items())
                with contextlib.ExitStack() as stack, case(name):
                    test(**_renew_fixtures(given, number, stack), **arguments)

        run.__signature__ = signature.replace(parameters=fixtures)  # type: ignore[attr-defined]
        return run

    return decorate


def _renew_fixtures(
    given: dict[str, Any], number: int, stack: contextlib.ExitStack
) -> dict[str, Any]:
    """Return the fixtures for one value; pytest makes them once for the whole test."""
    renewed = dict(given)
    if "tmp_path" in given:
        renewed["tmp_path"] = Path(given["tmp_path"]) / f"value-{number}"
        renewed["tmp_path"].mkdir()
    if "monkeypatch" in given:
        patch: pytest.MonkeyPatch = given["monkeypatch"]
        renewed["monkeypatch"] = stack.enter_context(patch.context())
    return renewed


def with_folders(root: Path, cases: Iterable[Any]) -> Iterator[tuple[Path, Any]]:
    """Yield each case with an empty folder below `root`."""
    for number, each in enumerate(cases):
        folder = root / str(number)
        folder.mkdir()
        yield folder, each

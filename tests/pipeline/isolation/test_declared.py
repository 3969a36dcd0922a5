"""Every function that is called in a child says what it returns, in types that can be checked."""

import ast
import importlib
from collections.abc import Iterator

import pytest

from pipeline.isolation.answers import declared_form
from storage.installation import module_name
from tests.conftest import ROOT

_CALLS = {"call_with_retries": 1, "_call": 1, "call": 0}
"""Who calls in a child, and which of its arguments is the function."""


def _called() -> Iterator[tuple[str, str]]:
    """Yield (module, function) of what is handed to such a call by its name."""
    for package in ("pipeline", "infra"):
        for path in sorted((ROOT / package).rglob("*.py")):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            for node in ast.walk(ast.parse(path.read_text())):
                name = _function_of(node)
                if name:
                    yield module, name


def _function_of(node: ast.AST) -> str | None:
    if not isinstance(node, ast.Call):
        return None
    called = node.func
    name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
    if name not in _CALLS or len(node.args) <= _CALLS[name]:
        return None
    given = node.args[_CALLS[name]]
    if isinstance(given, ast.Attribute) and isinstance(given.value, ast.Name):
        return f"{given.value.id}.{given.attr}"
    return given.id if isinstance(given, ast.Name) else None


def _found(module: str, name: str) -> object:
    found: object = importlib.import_module(module_name(module))
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


def test_what_is_called_in_children_can_be_checked() -> None:
    pytest.importorskip("torch", reason="some of it needs torch")
    functions = {each: _found(*each) for each in _called()}
    known = {each: found for each, found in functions.items() if callable(found)}
    assert len(known) > 20, "the walk finds them"
    wrong = {}
    for each, function in known.items():
        try:
            declared_form(function)
        except TypeError as error:
            wrong[each] = str(error)
    assert not wrong

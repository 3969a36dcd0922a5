"""Every function that is called in a child says what it returns, in types that can be checked."""

import ast
import contextlib
import importlib
import inspect
import operator
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.exchange.convert import convert_sources
from pipeline.exchange.formats import SceneSource
from pipeline.exchange.open_scene import load_cameras, load_source, source_keys
from pipeline.generation.inspect_scene import _facts
from pipeline.isolation.answers import decode_answer, encode_result
from pipeline.isolation.result_schema import result_reader
from storage.installation import module_name
from tests.conftest import ROOT
from tests.scenes_by_hand import tiny_scene
from trilight import write_scene

CALLS = {"call_with_retries": 1, "_call": 1, "call": 0, "call_method": 0}
"""Who calls in a child, and which of its arguments is the function."""


def _called() -> Iterator[tuple[str, str]]:
    """Yield module and source text of what is handed to such a call by its name."""
    for path in sorted(
        path for top in ("pipeline", "infra") for path in (ROOT / top).rglob("*.py")
    ):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            at = CALLS.get(getattr(node.func, "attr", getattr(node.func, "id", "")), 99)
            for each in map(ast.walk, node.args[at : at + 1]):  # each of `a if b else c`
                yield from (
                    (module, ast.unparse(one))
                    for one in each
                    if isinstance(one, ast.Name | ast.Attribute)
                )


def test_what_is_called_in_children_declares_what_can_be_checked() -> None:
    pytest.importorskip("torch", reason="some of it needs torch")
    known: dict[tuple[str, str], Any] = {}
    for module, name in _called():
        with contextlib.suppress(AttributeError):  # a name within a function
            held = importlib.import_module(module_name(module))
            known[module, name] = operator.attrgetter(name)(held)
    known = {key: one for key, one in known.items() if inspect.isfunction(one)}
    assert len(known) > 35, "the walk finds them"
    assert {name for _, name in known} >= {"attempt_in_child", "SceneWorker.attempt", "load_source"}
    undeclared = {}
    for each, function in known.items():
        try:
            assert "return" in function.__annotations__, "says nothing"
            result_reader(function)
        except (TypeError, AssertionError) as error:
            undeclared[each] = str(error)
    assert not undeclared


def test_a_real_answer_is_as_declared(tmp_path: Path) -> None:
    """Of meshes and renders too: tests/infra/child_here.py reads each answer as an owner does."""
    write_scene(tiny_scene(), tmp_path / "scene.json")
    source = SceneSource(path=tmp_path / "scene.json", key=None)
    calls: list[tuple[Callable[..., Any], Any]] = [
        (each, each(source)) for each in (load_source, load_cameras, source_keys, _facts)
    ]
    calls.append((convert_sources, convert_sources([source], tmp_path / "out.glb", None)))
    for function, value in calls:
        sent = encode_result(value)
        answer = decode_answer([np.frombuffer(part, np.uint8).copy() for part in sent], function)
        assert isinstance(answer, type(value) | tuple)
        assert encode_result(answer) == sent

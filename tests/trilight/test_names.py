"""What `import trilight` offers: the same names to programs, to type checkers, and in documents."""

import ast
import re
from importlib import metadata
from pathlib import Path

import pytest

import trilight
from infra.setup.wheel_tree import PACKAGES
from tests.conftest import ROOT
from tests.for_each import for_each
from trilight import extend


def test_every_name_is_there() -> None:
    for name in trilight.__all__:
        assert getattr(trilight, name) is not None, name
    assert trilight.__version__ == metadata.version("trilight")
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        trilight.rendr  # noqa: B018


def test_no_name_is_one_that_a_wheel_needs() -> None:
    """There `trilight.train` is a package: importing it would replace a function of that name."""
    modules = {path.stem for path in (ROOT / "trilight").glob("*.py")}
    assert not {*trilight.__all__, *modules} & {*PACKAGES, "tests"}


def test_extensions_have_one_place_to_import_from() -> None:
    for name in extend.__all__:
        assert getattr(extend, name) is not None, name
    with pytest.raises(AttributeError, match="no attribute 'TEMPLATE'"):
        extend.TEMPLATE  # noqa: B018


@for_each("example", sorted((ROOT / "examples").glob("*.py")))
def test_examples_import_from_the_face_alone(example: Path) -> None:
    ours = {
        node.module
        for node in ast.walk(ast.parse(example.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES
    }
    assert not ours


@for_each("page", ["docs/reference/python.md", "README.md"])
def test_documents_name_what_is_there(page: str) -> None:
    text = (ROOT / page).read_text()
    named = set(re.findall(r"\btrilight\.([A-Za-z_]+)", "\n".join(_code(text))))
    assert named <= {*trilight.__all__, "extend"}


def _code(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)

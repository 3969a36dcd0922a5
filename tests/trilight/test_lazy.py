"""Exports of a module by the imports that type checkers read."""

from pathlib import Path

from trilight.lazy import offered_names


def test_a_name_is_exported_as_its_import_calls_it(tmp_path: Path) -> None:
    module = tmp_path / "package.py"
    module.write_text(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n"
        "    from json import dumps as dumps\n"
        "    from os.path import join as joined, split as split\n"
    )
    assert offered_names(str(module)) == {
        "dumps": ("json", "dumps"),
        "joined": ("os.path", "join"),
        "split": ("os.path", "split"),
    }

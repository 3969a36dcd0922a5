"""Files of a user's own: loaded once, recorded by their bytes, and every mistake is one line."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage import extensions
from storage.errors import TrilightError
from storage.extensions import (
    VARIABLE,
    extension_digests,
    is_reference,
    load_extension,
    load_named_extensions,
    load_same,
    loaded_files,
    require_same_extensions,
    short_name,
)
from storage.registry import Registry
from tests.command_line import run_program
from tests.extensions_kit import room_for_extensions, written
from tests.for_each import case, for_each

WORDS: Registry[str] = Registry("word", str, {"one": "1"}, decides=("data",))
"""A table to which the extensions of these tests add."""
FREE: Registry[str] = Registry("free word", str, {})
"""One that decides nothing."""

ADDS = "from tests.storage.test_extensions import WORDS\nWORDS.register('two', '2')\n"


@pytest.fixture(autouse=True)
def _alone() -> Iterator[None]:
    with room_for_extensions():
        yield


def test_what_an_extension_adds_comes_after_ours_and_can_be_taken_back(tmp_path: Path) -> None:
    extension = load_extension(written(tmp_path, ADDS))
    assert list(WORDS) == ["one", "two"]
    assert (WORDS.is_ours("one"), WORDS.is_ours("two")) == (True, False)
    assert load_extension(extension.path) is extension  # and did not run again
    extensions.unload(extension)
    assert list(WORDS) == ["one"]
    assert VARIABLE not in os.environ or not os.environ[VARIABLE]


def test_processes_that_start_from_here_load_the_same(tmp_path: Path) -> None:
    path = written(tmp_path, "VALUE = 7\n")
    load_extension(path)
    code = (
        "import sys; from storage.extensions import load_named_extensions; "
        "load_named_extensions(); print(sys.modules['trilight_extension_own'].VALUE)"
    )
    assert run_program([sys.executable, "-c", code]).stdout == "7\n"


@for_each(
    ("text", "message"),
    [
        ("x = 1\nfoo bar\n", "extension own.py, line 2: SyntaxError: invalid syntax."),
        ("\n\n1 / 0\n", "extension own.py, line 3: ZeroDivisionError: division by zero."),
        ("import sys\nsys.exit('no')\n", "extension own.py, line 2: SystemExit: no."),
        ("import nowhere\n", "line 1: ModuleNotFoundError: No module named 'nowhere'."),
        (f"{ADDS}WORDS.register('two', '')\n", "line 3: word 'two' is taken by own.py; expected"),
        (ADDS.replace("two", "one"), "line 2: word 'one' is taken by Trilight itself; expected"),
        (ADDS.replace("'2'", "2"), "line 2: word 'two' is a int; expected a str."),
        (ADDS.replace("two", "t w o"), "line 2: word 't w o': not a valid name; expected up to"),
    ],
)
def test_mistakes_in_a_file_are_one_line_that_names_it(
    tmp_path: Path, text: str, message: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(TrilightError) as caught:
        load_extension(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(WORDS) == ["one"]  # what it had added before is taken back
    path.write_text(ADDS)
    with room_for_extensions():
        load_extension(path)  # and mended, it loads


def test_no_file_of_python_two_of_one_name_and_one_that_changes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.py").mkdir()
    (tmp_path / "own.txt").touch()
    for name in ("nowhere.py", "folder.py", "own.txt", f"a{os.pathsep}b.py"):
        with pytest.raises(TrilightError, match=r"^extension .*(expected a Python file|cannot be)"):
            load_extension(tmp_path / name)
    (tmp_path / "other").mkdir()
    load_extension(written(tmp_path, ADDS))
    with pytest.raises(TrilightError, match=r"another own\.py is loaded already"):
        load_extension(written(tmp_path / "other", ADDS))
    files = loaded_files()
    load_same(files)
    with pytest.raises(TrilightError, match=r"extension own\.py has changed while a run was using"):
        load_same([(path, "0" * 64) for path, _ in files])


def test_what_decides_nothing_is_not_recorded(tmp_path: Path) -> None:
    """How a run is executed, or judged, changes nothing of what it means (DESIGN, 11)."""
    free = "from tests.storage.test_extensions import FREE\nFREE.register('w', '')\n"
    load_extension(written(tmp_path, free, "free.py"))
    assert extension_digests("data") == extension_digests("weights") == {}
    data = load_extension(written(tmp_path, ADDS, "data.py"))
    assert extension_digests("data") == {"data.py": data.sha256}
    assert extension_digests("weights") == {}
    load_extension(written(tmp_path, "import numpy\n", "silent.py"))  # may have done anything
    assert set(extension_digests("data")) == {"data.py", "silent.py"}
    assert set(extension_digests("weights")) == {"silent.py"}


def test_other_extensions_are_refused_with_a_next_step() -> None:
    for before, now, message in [
        ({}, {"a.py": "1"}, "begun without the extension a.py; leave --extend a.py away"),
        ({"a.py": "1"}, {}, "begun with the extension a.py, which is not given; add --extend a.py"),
        ({"a.py": "1"}, {"a.py": "2"}, "another extension a.py: its sha256 was 1, now 2; restore"),
    ]:
        with case(before):
            require_same_extensions("it", before, before)
            with pytest.raises(TrilightError) as caught:
                require_same_extensions("it", before, now)
            assert message in str(caught.value)


def test_what_decides_something_is_registered_by_a_file_that_a_person_named(tmp_path: Path) -> None:
    """Else a dataset would be made of it that could not say so, and children would not know it.

    Only `resolve`, which a command line calls with what a person typed, looks at files.
    """
    with pytest.raises(TrilightError, match="word 'two' is registered outside an extension, so"):
        WORDS.register("two", "2")
    path = written(tmp_path, "raise SystemExit\n")
    with pytest.raises(TrilightError, match="is unknown; expected one of one"):
        WORDS.find(f"{path}:seven")


def test_functions_of_a_file_are_named_by_both(tmp_path: Path) -> None:
    path = written(tmp_path, "def seven():\n    return '7'\n\ndef bad():\n    return 1 / 0\n")
    assert is_reference(f"{path}:seven")
    assert not any(map(is_reference, ("smoke", "a.py", "a.py:", "s3://b/a.py", "a.py:b-c")))
    name = WORDS.resolve(f"{path}:seven", str)
    assert (name, WORDS[name]) == ("own.py:seven", "7")
    assert short_name(f"{path}:seven") == "own.py:seven"
    assert WORDS.resolve("own.py:seven", str) == name  # as it is recorded, once it is loaded
    assert WORDS.resolve("one", str) == "one"
    with pytest.raises(TrilightError, match=r"own\.py does not define eleven; did you mean seven"):
        WORDS.resolve(f"{path}:eleven", str)
    with pytest.raises(TrilightError, match=r"own\.py, line 5: ZeroDivisionError"):
        WORDS.resolve(f"{path}:bad", str)


def test_the_variable_names_several(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [written(tmp_path, "", f"{name}.py") for name in "ab"]
    monkeypatch.setenv(VARIABLE, os.pathsep.join(map(str, paths)))
    load_named_extensions()
    assert [path for path, _ in loaded_files()] == list(map(str, paths))

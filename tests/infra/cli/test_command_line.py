"""What every command has in common: help that says all, completion, a version, near names."""

import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

import pytest

from infra.cli import console
from infra.cli.commands import COMMANDS
from infra.cli.options import ALIASES, choices_of, is_repeated, takes_names, value_of
from infra.cli.options import kind_of as kind_of_field
from infra.setup.command_line_page import every_command
from infra.setup.generated_pages import PAGES
from pipeline.shards.expression import TEXTS, condition, kind_of
from storage.records.quantities import QUANTITIES
from storage.settings.fields import option_of
from tests.command_line import trilight
from tests.conftest import ROOT
from tests.for_each import case

ALL = {found.name: found for found in every_command()}
TYPED = "pre"
COMPLETED = {
    "zsh": "",
    "bash": f"source FILE; COMP_WORDS=(trilight generate {TYPED}); COMP_CWORD=2; _trilight; "
    'printf "%s\\n" "${COMPREPLY[@]}"',
    "fish": f"source FILE; complete -C 'trilight generate {TYPED}'",
}


def test_every_command_is_there_with_those_within() -> None:
    assert {name.split()[0] for name in ALL} == set(COMMANDS)
    assert {"shards merge", "shards select", "shards reshard"} < set(ALL)


def test_every_option_says_what_it_is_and_its_default() -> None:
    for name in ALL:
        with case(name):
            for option in ALL[name].options:
                assert option.help[0].isupper() or ": " in option.help
                facts = option.help.rpartition(" [")[2]
                said = "default" in option.help or "required" in facts
                assert said or not option.takes, f"{option.names}: {option.help}"


def test_no_help_text_is_lost_at_80_columns() -> None:
    """Rich would take `[builtin:]` for a style and drop it."""
    for name in ALL:
        with case(name):
            shown = trilight([*name.split(), "--help"], env={"COLUMNS": "80"})
            assert max(map(len, shown.stdout.splitlines())) <= 80
            words = shown.stdout.split()
            for option in ALL[name].options:
                assert set(option.help.split()) <= set(words), option.names


def test_every_name_is_that_of_its_field() -> None:
    for found in ALL.values():
        for option in found.options:
            if option.names[0].startswith("--"):
                assert option.names[0] == option_of(option.field)
            assert option.names[1:] == tuple(filter(None, [ALIASES.get(option.field)]))


def test_the_short_option_helps_everywhere() -> None:
    for words in (["-h"], ["verify", "-h"], ["shards", "-h"], ["shards", "merge", "-h"]):
        shown = trilight(words)
        assert shown.exit_code == 0
        assert shown.stdout.startswith(f"Usage: {' '.join(['trilight', *words[:-1]])} ")


def test_no_words_are_a_question_for_help_and_the_version_is_a_number() -> None:
    assert trilight([]).stdout == trilight(["--help"]).stdout
    assert "--extend FILE.py" in trilight([]).stdout
    shown = trilight(["--version"])
    assert (shown.exit_code, shown.stdout.split()[0]) == (0, "trilight")
    assert shown.stdout.split()[1][0].isdigit()


MISTAKES = {
    "evaluat": "command 'evaluat' is unknown; did you mean evaluate? Expected one of doctor,",
    "shards merg": "shards: command 'merg' is unknown; did you mean merge?",
    "generate smoke --objekts x": "option '--objekts' is unknown; did you mean --objects?",
    "verify": "verify: DATASET is missing; expected: Dataset, a folder",
    "generate smoke --seed": "generate: --seed has no value; expected: Seed of objects",
    "generate smoke --seed 1 --seed 2": "generate: --seed is given twice; expected it once.",
    "verify here there": "verify: 'there' is one argument too many",
    "verify here --fast=3": "verify: --fast is '3'; expected no value.",
    "render x --out y.exr --engine neurl": "--engine is 'neurl'; did you mean neural? Expected",
}


def test_a_mistyped_command_line_is_one_line() -> None:
    for words in MISTAKES:
        with case(words):
            ended = trilight(words.split())
            assert (ended.exit_code, ended.stdout) == (2, "")
            assert ended.stderr.startswith("trilight: ") and ended.stderr.count("\n") == 1
            assert MISTAKES[words] in ended.stderr
            assert (
                f"See trilight {words.split()[0] if ': ' in ended.stderr[10:] else ''}"
                in ended.stderr
            )


REFUSED = {
    "generate smoke --scenes 0": "--scenes is 0; expected a whole number from 1 to 1000000000",
    "generate smoke --noise-floor nan": "--noise-floor-db is nan; expected a number above 0",
    "render x --out y.exr --exposure -99": "--exposure-ev is -99",
}


def test_a_value_that_the_settings_refuse_is_named_by_its_option() -> None:
    for words in REFUSED:
        with case(words):
            ended = trilight(words.split())
            assert ended.exit_code == 1
            assert ended.stderr.startswith(f"trilight: {REFUSED[words]}")


def test_the_real_command_names_no_module() -> None:
    found = _run([sys.executable, "-m", "trilight", "verify"], dict(os.environ))
    assert found.returncode == 2
    assert "infra.cli" not in found.stdout + found.stderr
    assert "trilight verify" in found.stdout + found.stderr


def test_too_little_memory_is_one_sentence(tmp_path: Path) -> None:
    """Where more is left, libraries end the process in ways of their own."""
    train = f"{sys.executable} -m trilight train smoke --data {tmp_path} --out {tmp_path}/run"
    ended = _run(["bash", "-c", f"ulimit -v 300000; exec {train}"], dict(os.environ))
    *before, last = ended.stderr.splitlines()
    assert ended.returncode == 1 and "Traceback" not in " ".join(before)
    assert last.startswith("trilight: too little memory") and last.endswith("raise `ulimit -v`.")


def _run(words: list[str], environment: dict[str, str]) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


def test_completion_installs_and_completes(tmp_path: Path) -> None:
    """In a home of its own; the shell itself asks for the names of builds."""
    home = {**os.environ, "HOME": str(tmp_path), "PATH": f"{_bin(tmp_path)}:{os.environ['PATH']}"}
    for shell, typed in COMPLETED.items():
        script = tmp_path / f"completion of {shell}"
        words = ["--install-completion", "--shell", shell, "--output", str(script)]
        with case(shell):
            installed = trilight(words, env={"HOME": str(tmp_path)})
            assert installed.exit_code == 0, installed.stderr
            text = script.read_text()
            assert "--albedo-over-one" in text and "refuse" in text
            if typed and shutil.which(shell) is not None:
                asked = [shell, "-c", typed.replace("FILE", shlex.quote(str(script)))]
                assert _run(asked, home).stdout.split() == ["pretrain-256"]


def _bin(folder: Path) -> Path:
    """Return a folder with the command of this checkout."""
    program = folder / "bin" / "trilight"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m trilight "$@"\n')
    program.chmod(0o755)
    return program.parent


def test_an_option_that_two_classes_have_is_refused() -> None:
    from infra.cli.options import OutputOptions, command

    def twice(one: OutputOptions, other: OutputOptions) -> None:
        pass

    with pytest.raises(AssertionError, match="json"):
        command()(twice)


WORDS: dict[Any, tuple[str | tuple[str, ...], Any]] = {
    int: ("3", 3),
    float: ("0.5", 0.5),
    str: ("3", "3"),
    Path: ("a/b", Path("a/b")),
    Literal["fast", "high"]: ("fast", "fast"),
    tuple[float, ...]: (("1", "2.5"), (1.0, 2.5)),
    tuple[Literal["a", "b"], ...]: (("a", "b"), ("a", "b")),
    Mapping[str, Any]: (("a.b=3", "c=x"), {"a.b": 3, "c": "x"}),
}


def test_an_optional_field_takes_the_words_that_it_takes_otherwise() -> None:
    for hint, (words, value) in WORDS.items():
        for each in (hint, hint | None, Optional[hint], Annotated[hint | None, "a note"]):  # noqa: UP045
            with case(each):
                assert value_of(words, each) == value
                for ask in (choices_of, kind_of_field, is_repeated, takes_names):
                    assert ask(each) == ask(hint)


INTERRUPTED_WRITE = """
import io, os, signal, sys
from infra.cli.process_exit import leave

class Interrupted(io.RawIOBase):
    def writable(self):
        return True
    def fileno(self):
        return NUMBER
    def write(self, data):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):  # Python answers a signal between two of its instructions
            pass
        return os.write(NUMBER, data)

signal.signal(signal.SIGINT, lambda number, frame: leave("interrupted", 130))
stream = io.TextIOWrapper(io.BufferedWriter(Interrupted()))
sys.NAME = sys.__NAME__ = stream
stream.write("words\\n")
stream.flush()
"""


@pytest.mark.parametrize(("name", "number"), [("stdout", 1), ("stderr", 2)])
def test_a_signal_in_the_middle_of_a_write_is_answered(name: str, number: int) -> None:
    program = INTERRUPTED_WRITE.replace("NUMBER", str(number)).replace("NAME", name)
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (130, "interrupted\n")


def test_the_page_of_quantities_names_what_a_condition_can_ask() -> None:
    page = PAGES["quantities"]()
    for name in (*QUANTITIES, *TEXTS):
        assert kind_of(name) is not None
        assert f"| `{name}` |" in page
    shown = [line.split("'")[1] for line in page.splitlines() if "--where" in line]
    assert len(shown) == 3
    for text in shown:
        condition(text)


def test_what_is_printed_tells_the_terminal_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Strangers' names hold no escapes, no colors of rich and no emojis, however they are shown."""
    obeyed = [*range(9), *range(11, 32), *range(0x7F, 0xA0), 0x202E, 0x2066, 0x200F]
    for code in obeyed:
        name = f"a{chr(code)}]0;b [/x] [red]c :bomb:"
        out = io.StringIO()
        shown = console._TextConsole(
            file=out, width=200, force_terminal=True, markup=False, emoji=False
        )
        monkeypatch.setattr(console, "console", shown)
        with case(code):
            shown.print(name)
            console.print_rows(name, [(name, name)])
            console.print_table(name, [{name: name}])
            console.note(name)
            console.first_words(name)
            console.look_at(name)
            console.next_step([name])
            with console.progress_bars() as bars:
                bars.update(bars.add_task(name, total=2, note=name), completed=1)
                bars.console.print(f"{name}")
            text = out.getvalue()
            assert f"{chr(code)}]0" not in text
            plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)
            assert (
                plain.count("a]0;b [/x] [red]c :bomb:") >= 8
            )  # some are cut where the terminal ends

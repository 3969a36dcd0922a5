"""What every command has in common: help, completion, near names; and what lies around a run."""

import io
import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

import pytest

from infra.cli import console
from infra.cli.commands import COMMANDS, EVERYDAY, SECTIONS
from infra.cli.options import takes_names, value_of
from infra.setup.generated_pages import PAGES, every_command
from model.config import SIZES
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from pipeline.shards.expression import TEXTS, condition, kind_of
from storage.records.quantities import QUANTITIES
from storage.settings.fields import option_of
from storage.settings.overrides import apply_overrides
from tests.command_line import run_program, trilight
from tests.end_to_end.conftest import command
from tests.end_to_end.production_kit import SIXTEEN_SAMPLES
from tests.for_each import case
from tests.scenes_by_hand import tiny_scene
from train.presets import TRAINING_PRESETS
from trilight import write_scene

ALL = {found.name: found for found in every_command()}
TYPED = "pre"
COMPLETED = {
    "zsh": "",
    "bash": f"source FILE; COMP_WORDS=(trilight generate {TYPED}); COMP_CWORD=2; _trilight; "
    'printf "%s\\n" "${COMPREPLY[@]}"',
    "fish": f"source FILE; complete -C 'trilight generate {TYPED}'",
}


def test_every_option_says_what_it_is_and_its_default() -> None:
    """At 80 columns no text is lost: Rich would take `[builtin:]` for a style and drop it."""
    for name in ALL:
        with case(name):
            shown = trilight([*name.split(), "--help-all"], env={"COLUMNS": "80"}).stdout
            assert shown.startswith(f"Usage: trilight {name} ")
            assert max(map(len, shown.splitlines())) <= 80
            for option in ALL[name].options:
                assert option.help[0].isupper() or ": " in option.help
                facts = option.help.rpartition(" [")[2]
                said = "default" in option.help or "required" in facts
                assert said or not option.takes, f"{option.names}: {option.help}"
                assert set(option.help.split()) <= set(shown.split()), option.names
                if option.names[0].startswith("--"):
                    assert option.names[-1] == option_of(option.field)


def test_help_shows_everyday_options_and_three_examples_first() -> None:
    assert set(EVERYDAY) == set(ALL)
    for name, page in EVERYDAY.items():
        with case(name):
            shown = trilight([*name.split(), "-h"], env={"COLUMNS": "80"}).stdout
            assert len(page.examples) == 3
            options = {option.field: option for option in ALL[name].options}
            assert set(page.options) <= set(options)
            for option in options.values():
                is_argument = not option.names[0].startswith("--")
                everyday = not page.options or option.field in (*page.options, "json")
                listed = re.search(rf"^   {option.names[0]}(?![\w-])", shown, re.MULTILINE)
                assert bool(listed) == (is_argument or everyday), option.names
            assert ("--help-all" in shown) == (len(page.options) > 0)
            for example in page.examples:
                assert f"   {example}\n" in shown
                words = shlex.split(example)[1:]
                known = {each for option in options.values() for each in option.names}
                typed = {word.split("=")[0] for word in words if word.startswith("--")}
                assert typed <= {*known, "--extend"}


def test_the_first_page_has_five_sections_and_a_first_command() -> None:
    shown = trilight([]).stdout
    assert shown == trilight(["--help"]).stdout == trilight(["-h"]).stdout
    assert "First time? trilight generate tiny --out" in shown and "--extend FILE.py" in shown
    for title, names in SECTIONS.items():
        assert f"\n{title}:\n" in shown
        assert all(re.search(rf"^   {name} ", shown, re.MULTILINE) for name in names)
    assert sorted(sum(SECTIONS.values(), ())) == sorted(COMMANDS)
    assert trilight(["shards", "-h"]).stdout.startswith("Usage: trilight shards ")
    version = trilight(["--version"])
    assert version.exit_code == 0 and re.match(r"trilight \d", version.stdout)


def test_presets_lists_names_for_people_and_settings_as_set_takes_them() -> None:
    shown = trilight(["presets"], env={"COLUMNS": "120"}).stdout
    for name in (
        *DATASET_PRESETS,
        *TRAINING_PRESETS,
        *SIZES,
        "tiny (stored: smoke)",
        "default (stored: builtin:)",
    ):
        assert name in shown
    assert json.loads(trilight(["presets", "--json"]).stdout)["datasets"][0]["scenes"] == 24
    told = json.loads(trilight(["presets", "tiny", "--json"]).stdout)
    values = told["trilight generate tiny"]
    assert apply_overrides(preset_settings("pretrain-256"), values) == preset_settings("tiny")
    assert told["trilight train tiny"]["num_steps"] == TRAINING_PRESETS["smoke"]().num_steps
    assert "renders.resolution" in trilight(["presets", "pretrain-256"]).stdout
    assert "did you mean tiny?" in trilight(["presets", "tny"]).mistake


MISTAKES = {
    "evaluat": "command 'evaluat' is unknown; did you mean evaluate? Expected one of generate,",
    "shards merg": "shards: command 'merg' is unknown; did you mean merge?",
    "generate smoke --objekts x": "option '--objekts' is unknown; did you mean --objects?",
    "submit slurm smoke --image x": "submit slurm: option '--image' is unknown",
    "verify": "verify: DATASET is missing; expected: Dataset, a folder",
    "generate smoke --seed": "generate: --seed has no value; expected: Seed of objects",
    "generate smoke --seed 1 --seed 2": "generate: --seed is given twice; expected it once.",
    "verify here there": "verify: 'there' is one argument too many",
    "verify here --fast=3": "verify: --fast is '3'; expected no value.",
    "render x --out y.exr --engine neurl": "--engine is 'neurl'; did you mean neural? Expected",
}
"""What is mistyped."""
REFUSED = {
    "generate smoke --scenes 0": "--scenes is 0; expected a whole number from 1 to 1000000000",
    "generate smoke --noise-floor nan": "--noise-floor is nan; expected a number above 0",
    "render x --out y.exr --exposure -99": "--exposure is -99",
    "leaderboard set --resolution 0": "--resolution is 0; expected a list, each entry a whole "
    "number from 1 to 8192 pixels",
    "status nowhere --price -1": "--price is -1.0; expected a number from 0 to 1000 USD per core-h",
    "status set --lines": "--lines is given; expected it only",
    "model huge": "model 'huge': neither a size nor a checkpoint here",
    "model large --resolution 72": "--resolution is 72; expected a multiple of 64",
    "model smoke --publish x": "model: --publish needs a checkpoint",
    "submit x smoke": "flow 'x' is unknown; expected one of slurm, kubernetes, generate-scenes",
    "bench rungs-64": "experiment 'rungs-64' is unknown; expected one of calibration, cycles, "
    "frontier, gpu, growth, loader, meshes, methods, paired-training, relighting",
}
"""Values that the settings refuse, each named by its option, before anything is done."""


def test_what_cannot_be_asked_is_one_line() -> None:
    for words, message in MISTAKES.items():
        with case(words):
            ended = trilight(words.split())
            assert (ended.exit_code, ended.stdout) == (2, "")
            assert message in ended.mistake
            see = words.split()[0] if ": " in ended.mistake else ""
            assert f"See trilight {see}" in ended.mistake
    for words, message in REFUSED.items():
        with case(words):
            ended = trilight(words.split())
            assert ended.exit_code == 1 and ended.mistake.startswith(message)


def test_the_real_command_names_no_module_and_lacks_memory_in_one_sentence(tmp_path: Path) -> None:
    found = run_program([sys.executable, "-m", "trilight", "verify"], status=2)
    assert "infra.cli" not in found.stdout + found.stderr
    assert "trilight verify" in found.stdout + found.stderr
    # where more memory is left, libraries end the process in ways of their own
    train = f"{sys.executable} -m trilight train smoke --data {tmp_path} --out {tmp_path}/run"
    ended = run_program(["bash", "-c", f"ulimit -v 300000; exec {train}"], status=1)
    *before, last = ended.stderr.splitlines()
    assert "Traceback" not in " ".join(before)
    assert last.startswith("trilight: too little memory") and last.endswith("raise `ulimit -v`.")


def test_completion_installs_and_completes(tmp_path: Path) -> None:
    """In a home of its own; the shell itself asks for the names of presets."""
    program = tmp_path / "bin" / "trilight"  # the command of this checkout
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m trilight "$@"\n')
    program.chmod(0o755)
    path = f"{program.parent}:{os.environ['PATH']}"
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
                completed = run_program(asked, HOME=str(tmp_path), PATH=path)
                assert completed.stdout.split() == ["pretrain-256"]


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
                assert takes_names(each) == takes_names(hint)


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
    assert run_program([sys.executable, "-c", program], status=130).stderr == "interrupted\n"


def test_the_page_of_quantities_names_what_a_condition_can_ask() -> None:
    page = PAGES["quantities"]()
    for name in (*QUANTITIES, *TEXTS):
        assert kind_of(name) is not None
        assert f"| `{name}` |" in page
    shown = [line.split("'")[1] for line in page.splitlines() if "--where" in line]
    assert len(shown) == 3
    for text in shown:
        condition(text)


def test_a_log_has_a_line_of_progress_a_minute_and_a_digest_is_on_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    with console.Bars() as bars:
        task = bars.add_task("scenes", total=None, note="")
        for second in (59, 60, 61, 119, 120):
            now[0] = second
            bars.update(task, total=8, completed=second // 20, note="noted")
        bars.add_task("silent", total=1, note="", visible=False)
        now[0] = 240
        bars.advance(task)
        said = capsys.readouterr().out
    assert said.splitlines() == [f"scenes {done} of 8, noted" for done in (3, 6, 7)]
    out = io.StringIO()
    narrow = console._TextConsole(file=out, width=60, markup=False)
    monkeypatch.setattr(console, "console", narrow)
    console.print_rows("title", [("a long name of a digest", "ab" * 32), ("other", "words")])
    assert f"a long name of a digest {'ab' * 32}\n" in out.getvalue()


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
            console.suggest_look(name)
            console.next_step([name])
            with console.Bars() as bars:
                bars.update(bars.add_task(name, total=2, note=name), completed=1)
                bars.console.print(f"{name}")
            text = out.getvalue()
            assert f"{chr(code)}]0" not in text
            plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)
            assert (
                plain.count("a]0;b [/x] [red]c :bomb:") >= 8
            )  # some are cut where the terminal ends


NAMES = """
    calendar conftest email enum infra json logging matplotlib mitsuba model numpy prefect queue
    random re scene_templates secrets selectors signal sitecustomize socket storage string struct
    tempfile token torch train trimesh typing uuid
"""
"""Modules that Python, libraries or Trilight import somewhere."""
TRAP = "import os; open(os.path.join(os.path.dirname({file!r}), 'RAN'), 'a').write({name!r} + ' ')"
MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
SMALL = ("--objects", "builtin:4", "--scenes", "1", "--resolution", "64", *SIXTEEN_SAMPLES)
GENERATE = command("generate", "smoke", *SMALL, "--set", "splits.scenes_per_shard=1", "--out")
PROGRAM = """
import multiprocessing.forkserver, sys
from pipeline.isolation import ChildLimits, IsolatedChild
sys.path.insert(0, "")
limits = ChildLimits(memory_bytes=2 << 30, wall_s=99, calls_per_child=1)
IsolatedChild(limits=limits).call(print)
"""
"""A user's own, whose first import path is the working folder: the child's is not."""


def _trapped(folder: Path) -> Path:
    """Return a folder with an object, a scene, and files of these names, which leave a trace."""
    for name in NAMES.split():
        path = folder / f"{name}.py"
        path.write_text(TRAP.format(file=str(path), name=name))
    (folder / "pipeline").mkdir()
    trap = TRAP.format(file=str(folder / "x"), name="pipeline")
    (folder / "pipeline" / "__init__.py").write_text(trap)
    (folder / "mesh.obj").write_text(MESH)
    write_scene(tiny_scene(), folder / "scene.json")
    return folder


def test_a_conversion_runs_nothing_of_the_folder(tmp_path: Path) -> None:
    done = run_program(command("convert", "scene.json", "out.usdc"), _trapped(tmp_path))
    assert "Warning" not in done.stderr  # USD's own: a confined child may set no file's mode
    run_program([sys.executable, "-P", "-c", PROGRAM], tmp_path)
    assert not (tmp_path / "RAN").exists(), (tmp_path / "RAN").read_text()


def test_what_a_shell_leaves_a_run_is_one_sentence_or_works(tmp_path: Path) -> None:
    """Closed and full streams, a folder that is gone, names that are no text, few files."""
    program = " ".join(command())
    (tmp_path / "a").mkdir()
    cases = {
        f"{program} --version <&- >&- 2>&-": (0, ""),
        f"{program} --version > /dev/full": (1, "what is printed cannot be written (No space"),
        f"{program} verify none <&- >&-": (1, "none: no such folder"),
        f"cd a; rmdir ../a; {program} doctor": (1, "the working folder cannot be used (No such"),
        f"{program} verify $(printf '\\377')": (1, r"the name '\udcff' is no text in utf-8;"),
        f"ln -s l l; {program} generate smoke --out l": (1, "l/.staging: cannot write lock (Too"),
        f"TRILIGHT_CACHE=/dev/null/x {program} generate smoke --out o": (1, "'/dev/null' is no"),
        f"{program} verify \"$(printf 'e\\033]0')\"": (1, r"e\x1b]0: no such folder"),
        f"COLUMNS=0 MPLBACKEND=none PYTHONIOENCODING=ascii {program} convert s.json ö.glb | "
        r"grep -q '\\xf6.glb'": (0, ""),
        f"SOURCE_DATE_EPOCH=abc {program} assets m --out n": (0, ""),
        f"{program} assets '~nobody-of-this-name/x' --out o": (1, "does not exist"),
        f"ulimit -n 9; {program} convert s.json s.glb": (1, "Too many open files); see"),
        f"ulimit -v 4000000; TMPDIR=$PWD/{'t' * 120} {program} convert s.json s.glb": (0, ""),
    }
    write_scene(tiny_scene(), tmp_path / "s.json")
    (tmp_path / "m").mkdir()
    (tmp_path / "m/m.obj").write_text(MESH)
    (tmp_path / ("t" * 120)).mkdir()
    for line, (status, said) in cases.items():
        with case(line):
            run = run_program(["bash", "-c", line], tmp_path, status=status)
            assert run.stderr.count("\n") == status and said in run.stderr


@pytest.mark.slow("commands")
@pytest.mark.timeout(900)
def test_no_command_runs_a_file_of_the_folder(tmp_path: Path) -> None:
    """Nor do the processes that it starts: the fork server, probes, torchrun, a server."""
    folder = _trapped(tmp_path)
    fresh = str(tmp_path / "cache")  # so that renderers are tried anew
    torchrun = command("train", "smoke", "--data", "set", "--steps", "1", "--processes", "2")
    for words in (
        [*GENERATE, "set", "--runner", "prefect"],
        command("assets", ".", "--own-materials", "--out", "meshes"),
        command("doctor"),
        command("convert", "scene.json", "scene.glb"),
        command(
            "render", "scene.glb", "--out", "pictures", "--resolution", "8", "--noise-floor", "10"
        ),
        [*torchrun, "--device", "cpu", "--out", "run"],
    ):
        with case(words):
            run_program(words, folder, TRILIGHT_CACHE=fresh)
            assert not (folder / "RAN").exists(), (folder / "RAN").read_text()

"""What lies around a run: no file of the working folder is run, whatever its name."""

import sys
from pathlib import Path

import pytest

from tests.command_line import run_program
from tests.end_to_end.conftest import command
from tests.end_to_end.production_kit import SIXTEEN_SAMPLES
from tests.for_each import case
from tests.scenes_by_hand import tiny_scene
from trilight import write_scene

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
    run_program(command("convert", "scene.json", "out.glb"), _trapped(tmp_path))
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

"""A child that a file has taken over, or that dies: its tries are refused, its end is judged."""

import functools
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from pipeline.generation.prepare_isolated import asset_child
from pipeline.isolation import (
    ChildFailed,
    ChildLimits,
    IsolatedChild,
    call_failures,
    call_with_retries,
    confinement,
    is_transient,
    reach,
    system_calls,
)
from pipeline.isolation.call_failures import ENDS, with_retries
from pipeline.isolation.confinement import covers
from pipeline.isolation.system_calls import landlock_version, seccomp_works
from storage.errors import EnvironmentFailure, TrilightError
from tests.command_line import run_program
from tests.conftest import ROOT
from tests.for_each import case, for_each
from tests.pipeline.isolation import called, probes
from tests.pipeline.isolation.probes import PROBES

LIMITS = ChildLimits(memory_bytes=2 << 30, wall_s=120, calls_per_child=100)
needs_landlock = pytest.mark.skipif(not landlock_version(), reason="no Landlock here")
needs_seccomp = pytest.mark.skipif(not seccomp_works(), reason="no seccomp here")


def confined(*allowed: Path, writes: Sequence[Path] = ()) -> IsolatedChild:
    code = ROOT / "tests"  # the functions that are called
    return IsolatedChild(limits=LIMITS, confined_to=reach([code, *allowed]), writes=writes)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three folders: of inputs, of outputs, and of nobody's business."""
    root = tmp_path_factory.mktemp("place")
    for name in ("in", "out", "outside"):
        (root / name).mkdir()
        (root / name / "file").write_text(name)
    (root / "in" / "link").symlink_to(root / "outside" / "file")
    return root


@needs_landlock
def test_inputs_are_read_outputs_written_and_nothing_outside(place: Path) -> None:
    with closing(confined(place / "in" / "file", writes=[place / "out"])) as child:
        assert child.call(called.read, place / "in" / "file") == "in"
        child.call(called.write, place / "out" / "new")
        child.call(called.replace, place / "out" / "file", place / "out" / "new")
        assert (place / "out" / "file").read_text() == "written"
        outside = [place / name for name in ("outside/file", "in/link", "in/../outside/file")]
        secrets = Path(f"/proc/{os.getpid()}/environ")  # of another process
        assert child.call(called.refused_paths, [*outside, secrets], False) == [*outside, secrets]
        paths = [place / name for name in ("in/file", "in/new", "outside/file", "new")]
        assert child.call(called.refused_paths, paths, True) == paths
    assert (place / "in" / "file").read_text() == "in"


WALLS = ("rights", "seccomp", *(f"landlock {number}" for number in (1, 2, 3, 5, 6)), "all")


def _holds(wall: str, by: str) -> bool:
    """Return whether a wall is among those that hold a probe; a later Landlock holds more."""
    kind, _, version = wall.partition(" ")
    known = dict(each.partition(" ")[::2] for each in by.split(", "))
    return kind in known and int(version or 0) >= int(known[kind] or 0)


def _tried(place: Path, wall: str) -> Mapping[str, bool | None]:
    shutil.rmtree(place / "probed", ignore_errors=True)
    (place / "probed").mkdir()
    for name in PROBES:
        (place / "probed" / name).write_text(name)
    with (
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as victim,
        closing(IsolatedChild(limits=LIMITS)) as child,
    ):
        refused = child.call(probes.try_all, wall, place, victim.pid)
        victim.kill()
        return refused


@needs_landlock
@needs_seccomp
def test_each_wall_holds_what_the_page_says_of_it_and_no_more(place: Path) -> None:
    let_in = {name for name, refused in _tried(place, "").items() if refused is False}
    known = [wall for wall in WALLS if int(wall.partition(" ")[2] or 0) <= landlock_version()]
    for wall in known:
        walls = [*known[:2], f"landlock {landlock_version()}"] if wall == "all" else [wall]
        held = {name for name, (by, _) in PROBES.items() if any(_holds(one, by) for one in walls)}
        refused = {name for name, is_refused in _tried(place, wall).items() if is_refused}
        assert held & let_in <= refused, wall
        if wall != "rights":  # without these the kernel itself refuses more
            assert refused & let_in <= held, wall


TERMINAL = """
import pathlib
from pipeline.isolation import ChildLimits, IsolatedChild, reach
from tests.pipeline.isolation import called, probes
limits = ChildLimits(memory_bytes=2 << 30, wall_s=60, calls_per_child=9)
child = IsolatedChild(limits=limits, confined_to=reach([pathlib.Path("tests")]))
print(f"terminals: {child.call(probes.open_terminals)}")
"""


def test_a_child_has_no_terminal_and_what_it_prints_arrives_without_commands() -> None:
    ours, theirs = os.openpty()
    command = [sys.executable, "-c", TERMINAL]
    subprocess.run(command, cwd=ROOT, stdin=theirs, stdout=theirs, stderr=theirs, check=True)
    os.close(theirs)
    shown = os.read(ours, 1 << 16).decode()
    assert "terminals: []" in shown and "said\\x1b]0;title\\x07" in shown
    os.close(ours)


OWNER = """
import pathlib, sys
from pipeline.isolation import ChildLimits, IsolatedChild, reach
from tests.pipeline.isolation import called, probes
path = pathlib.Path(sys.argv[1])
limits = ChildLimits(memory_bytes=2 << 30, wall_s=60, calls_per_child=9)
files = reach([pathlib.Path("tests")]) if len(sys.argv) > 2 else None
child = IsolatedChild(limits=limits, confined_to=files, writes=[path.parent])
child.call(probes.stay, path, files is not None)
"""


@for_each("more", [(), ("confined",)])
def test_a_child_dies_with_an_owner_that_is_killed_though_it_would_not(
    tmp_path: Path, more: tuple[str, ...]
) -> None:
    said = tmp_path / "child"
    with subprocess.Popen([sys.executable, "-c", OWNER, str(said), *more], cwd=ROOT) as owner:
        _until(lambda: said.exists() and bool(said.read_text()), 60)
        owner.kill()
    process = Path(f"/proc/{said.read_text()}/stat")
    _until(lambda: not process.exists() or process.read_text().split()[2] == "Z", 10)


def _until(happened: Callable[[], bool], most_s: float) -> None:
    deadline_s = time.monotonic() + most_s
    while not happened():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


@needs_landlock
def test_another_folder_costs_a_fresh_child_and_the_same_one_none(place: Path) -> None:
    with closing(confined(place / "in")) as child:
        first = child.call(called.process_id)
        child.allow_files(reach([place / "in" / "file"]))
        assert child.call(called.process_id) == first
        child.allow_files(reach([place / "outside" / "file"]))
        assert child.call(called.read, place / "outside" / "file") == "outside"
        assert child.call(called.read, place / "in" / "file") == "in"
        assert child.call(called.process_id) != first


@needs_landlock
def test_packages_that_a_path_of_pythons_names_are_read_and_its_other_folders_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packages, other = tmp_path / "a module" / "site-packages", tmp_path / "other"
    for folder in (packages, other):
        folder.mkdir(parents=True)
        (folder / "file").write_text("found")
        monkeypatch.syspath_prepend(str(folder))
    with closing(confined()) as child:
        assert child.call(called.read, packages / "file") == "found"
        with pytest.raises(ChildFailed, match="PermissionError"):
            child.call(called.read, other / "file")


def test_off_confines_nothing_and_an_unknown_word_is_refused_at_once_by_every_command(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(confinement.VARIABLE, "off")
    with closing(confined(place / "in")) as child:
        assert child.call(called.read, place / "outside" / "file") == "outside"
    words, env = ["-m", "trilight", "doctor", "--help"], {confinement.VARIABLE: "maybe"}
    run = run_program([sys.executable, *words], status=1, env={**os.environ, **env})
    assert "'maybe'" in run.stderr


def test_what_cannot_be_had_is_said(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """At once: no child may be needed where all is cached."""
    monkeypatch.setattr(confinement, "landlock_version", lambda: 0)
    monkeypatch.setenv(confinement.VARIABLE, "no")
    with pytest.raises(TrilightError, match="auto"):
        asset_child()
    monkeypatch.setenv(confinement.VARIABLE, "required")
    with pytest.raises(EnvironmentFailure, match="lacks Landlock"):
        asset_child()
    monkeypatch.setenv(confinement.VARIABLE, "auto")
    confinement._warn.cache_clear()
    assert confinement.should_confine() and confinement.should_confine()
    assert [record.getMessage().count("lacks Landlock") for record in caplog.records] == [1]


def test_very_many_folders_become_those_above_and_never_the_whole_disk() -> None:
    many = reach(Path(f"/models/{number % 9}/{number}/a.obj") for number in range(900))
    assert len(many) <= confinement.MOST_FOLDERS
    assert all(path.is_relative_to("/models") for path in many)
    assert covers(many, reach([Path("/models/3/12/a.obj")]))
    assert not covers(many, reach([Path("/other/a.obj")]))
    wide = reach(Path(f"/{number}/a.obj") for number in range(900))
    assert Path("/") not in wide


def _decide(machine: str, call: int, argument: int = 0) -> int:
    """Return what the filter answers to a call whose arguments are all the same."""
    data = {0: call, 4: system_calls._MACHINES[machine][1], 16: argument, 24: argument}
    steps, at, loaded = system_calls._program(machine, 77), 0, 0
    passes = {0x15: int.__eq__, 0x35: int.__ge__, 0x45: int.__and__}
    while steps[at][0] != 0x06:
        code, then, otherwise, value = steps[at]
        loaded = data[value] if code == 0x20 else loaded
        at += 1 + (code != 0x20 and (then if passes[code](loaded, value) else otherwise))
    return steps[at][3]


@for_each(("machine", "column"), [("x86_64", 0), ("aarch64", 1)])
def test_the_filter_refuses_calls_by_number_and_by_argument(machine: str, column: int) -> None:
    allow, refuse = 0x7FFF0000, 0x50001
    numbers = [row[column] for row in system_calls._NUMBERS.values() if row[column] is not None]
    assert {_decide(machine, each) for each in (*numbers, 63 | 0x40000000)} == {refuse}  # type: ignore[arg-type]
    assert (_decide(machine, 63), _decide(machine, 435)) == (allow, 0x50026)
    for name, kept, given_up in (
        ("ioctl", 0x5401, 0x5412), ("fcntl", 4, 8), ("kill", 77, 78), ("tgkill", 77, 0),
        ("prlimit64", 0, 1), ("clone", 0x3D0F00, 0x1200011), ("prctl", 15, 1),
    ):  # fmt: skip
        number = system_calls._BY_ARGUMENT[name][:2][column]
        assert _decide(machine, number, kept) == allow, name
        assert _decide(machine, number, given_up) == refuse, name


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(call_failures, "_PAUSE_S", 0.0)


@pytest.fixture
def plain_child() -> Iterator[IsolatedChild]:
    with closing(IsolatedChild(limits=LIMITS)) as plain_child:
        yield plain_child


def test_a_signal_of_native_code_is_told_from_one_of_somebody_else(
    plain_child: IsolatedChild, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two as they happen, and others by the status of the child."""
    for end, reason in ((signal.SIGSEGV, "crashed_signal_11"), (signal.SIGTERM, "killed")):
        with pytest.raises(ChildFailed, match=end.name) as caught:
            plain_child.call(called.die_by, end)
        assert (caught.value.reason, caught.value.is_verdict) == (reason, reason != "killed")
    for number, reason in (
        (signal.SIGABRT, "crashed_signal_6"),
        (signal.SIGFPE, "crashed_signal_8"),
        (signal.SIGKILL, "killed"),
        (signal.SIGHUP, "killed"),
        (signal.SIGBUS, "killed"),
        (signal.SIGXCPU, "killed"),  # a limit of somebody else: these children have none
    ):
        ended = SimpleNamespace(exitcode=-number, join=lambda timeout_s: None)
        with monkeypatch.context() as patch, case(number):
            patch.setattr(plain_child, "_process", ended)
            death = plain_child._death()
        assert (death.reason, death.is_verdict) == (reason, reason != "killed")
        assert number.name in death.message


def test_tries_end_and_only_two_ends_are_verdicts() -> None:
    """A verdict may be kept, and lead to other data: whoever adds one must say so here."""
    for reason, end in ENDS.items():
        fail = Mock(side_effect=ChildFailed(reason, "as ever"))
        with case(reason), pytest.raises(ChildFailed) as caught:
            with_retries(fail)
        assert (fail.call_count, caught.value.is_verdict) == (end.tries, end.is_verdict), reason
    verdicts = {name for name, end in ENDS.items() if end.is_verdict}
    assert verdicts == {"timeout_cpu", "crashed_signal"}
    assert all(1 <= end.tries <= 3 for end in ENDS.values())
    tries = {name: ENDS[name].tries for name in ("killed", "exception", "crashed_signal")}
    assert tries == {"killed": 3, "exception": 3, "crashed_signal": 2}
    assert not is_transient("degenerate")


def test_kills_in_a_call_or_its_set_up_are_tried_again_and_end_the_run_at_last(
    plain_child: IsolatedChild, tmp_path: Path
) -> None:
    (tmp_path / "call").mkdir()
    call = called.count_and_die, str(tmp_path / "call"), signal.SIGKILL, 2
    assert call_with_retries(plain_child, *call) == 3
    (tmp_path / "once").mkdir()
    dying_child = functools.partial(IsolatedChild, limits=LIMITS, factory=called.count_and_die)
    with closing(dying_child(args=(str(tmp_path / "once"), signal.SIGKILL, 2))) as child:
        assert child.call(called.double, 4) == 8
    assert len(list((tmp_path / "once").iterdir())) == 3
    (tmp_path / "again").mkdir()
    child = dying_child(args=(str(tmp_path / "again"), signal.SIGKILL, 99))
    with pytest.raises(EnvironmentFailure, match="cannot be set up.*SIGKILL.*doctor"):
        child.call(called.double, 4)
    assert len(list((tmp_path / "again").iterdir())) == 3


def test_a_set_up_that_cannot_succeed_is_tried_once_at_each_call(tmp_path: Path) -> None:
    """And no call is made in a child that was not set up."""
    child = IsolatedChild(limits=LIMITS, factory=called.fail_set_up, args=(str(tmp_path),))
    with closing(child):
        for calls in (1, 2):
            with pytest.raises(EnvironmentFailure, match="cannot be set up.*a library is broken"):
                child.call(called.double, 4)
            assert len(list(tmp_path.iterdir())) == calls

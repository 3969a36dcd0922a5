"""A child that a file has taken over, or that dies: its tries are refused, its end is judged."""

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.isolation import (
    ChildFailed,
    ChildLimits,
    IsolatedChild,
    Reach,
    call_with_retries,
    confinement,
    deaths,
    is_passing,
    reach,
)
from pipeline.isolation.deaths import ENDS, with_retries
from pipeline.isolation.landlock import landlock_version
from pipeline.isolation.seccomp import _NUMBERS, _program, seccomp_works
from storage.errors import EnvironmentFailure, TrilightError
from tests.for_each import for_each
from tests.pipeline.isolation import called

LIMITS = ChildLimits(memory_bytes=2 << 30, wall_s=20, calls_per_child=100)
needs_landlock = pytest.mark.skipif(not landlock_version(), reason="no Landlock here")
needs_seccomp = pytest.mark.skipif(not seccomp_works(), reason="no seccomp here")


def confined(allowed: Reach) -> IsolatedChild:
    return IsolatedChild(limits=LIMITS, setup=called.nothing, confined_to=allowed)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three folders: of inputs, of outputs, and of nobody's business."""
    root = tmp_path_factory.mktemp("place")
    for name in ("in", "out", "outside"):
        (root / name).mkdir()
        (root / name / "file").write_text(name)
    (root / "in" / "link").symlink_to(root / "outside" / "file")
    return root


@pytest.fixture(scope="module")
def child(place: Path) -> Iterator[IsolatedChild]:
    child = confined(reach(files=[place / "in" / "file"], writes=[place / "out"]))
    yield child
    child.close()


def _refused(child: IsolatedChild, function: object, *args: object) -> None:
    with pytest.raises(ChildFailed, match="PermissionError"):
        child.call(function, *args)  # type: ignore[arg-type]


@needs_landlock
def test_inputs_are_read_outputs_written_and_nothing_outside(
    child: IsolatedChild, place: Path
) -> None:
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


@needs_seccomp
def test_nothing_is_connected_to_and_no_program_started(child: IsolatedChild) -> None:
    families = [int(each) for each in (socket.AF_INET, socket.AF_INET6, socket.AF_UNIX)]
    assert child.call(called.refused_sockets, families) == families
    _refused(child, called.start_program)


@pytest.mark.skipif(landlock_version() < 6, reason="Landlock of Linux 6.12 is needed")
def test_no_signal_reaches_another_process(child: IsolatedChild) -> None:
    _refused(child, called.end_process, os.getpid())


@needs_seccomp
@pytest.mark.skipif(os.uname().machine != "x86_64", reason="numbers of x86_64")
@for_each("name", ["ptrace", "mount", "bpf", "unshare", "keyctl", "io_uring_setup"])
def test_ways_around_are_refused(child: IsolatedChild, name: str) -> None:
    assert child.call(called.call_kernel, _NUMBERS[name][0]) == 1  # EPERM
    assert child.call(called.call_kernel, _NUMBERS[name][0] | 0x40000000) == 1  # by the second set
    assert child.call(called.call_kernel, 39) == 0  # getpid


@needs_landlock
def test_another_folder_costs_a_fresh_child_and_the_same_one_none(place: Path) -> None:
    with closing(confined(reach(files=[place / "in"]))) as child:
        first = child.call(called.process_id)
        child.may(reach(files=[place / "in" / "file"]))
        assert child.call(called.process_id) == first
        child.may(reach(files=[place / "outside" / "file"]))
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
    with closing(confined(reach())) as child:
        assert child.call(called.read, packages / "file") == "found"
        _refused(child, called.read, other / "file")


def test_off_confines_nothing(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(confinement.VARIABLE, "off")
    with closing(confined(reach(files=[place / "in"]))) as child:
        assert child.call(called.read, place / "outside" / "file") == "outside"


@for_each(
    ("word", "error", "said"),
    [("no", TrilightError, "auto"), ("required", EnvironmentFailure, "lacks Landlock")],
)
def test_what_cannot_be_had_is_said(
    monkeypatch: pytest.MonkeyPatch, word: str, error: type[Exception], said: str
) -> None:
    monkeypatch.setenv(confinement.VARIABLE, word)
    monkeypatch.setattr(confinement, "landlock_version", lambda: 0)
    child = confined(reach())
    with pytest.raises(error, match=said):
        child.call(called.double, 2)
    monkeypatch.setenv(confinement.VARIABLE, "auto")
    assert confinement.confinement_wanted()


def test_very_many_folders_become_those_above_and_never_the_whole_disk() -> None:
    many = reach(files=(Path(f"/models/{number % 9}/{number}/a.obj") for number in range(900)))
    assert len(many.reads) <= confinement.MOST_FOLDERS
    assert all(path.is_relative_to("/models") for path in many.reads)
    assert many.covers(reach(files=[Path("/models/3/12/a.obj")]))
    assert not many.covers(reach(files=[Path("/other/a.obj")]))
    wide = reach(files=(Path(f"/{number}/a.obj") for number in range(900)))
    assert Path("/") not in wide.reads


@for_each("machine", ["x86_64", "aarch64"])
def test_every_jump_of_the_filter_ends_at_its_last_two_steps(machine: str) -> None:
    steps = _program(machine)
    assert [step[0] for step in steps[-2:]] == [0x06, 0x06]
    for at, (_, taken, other, _) in enumerate(steps[3:-2], start=3):
        assert at + 1 + taken == len(steps) - 1
        assert other == 0
    assert 1 + 1 + steps[1][2] == len(steps) - 1  # another architecture


PATIENT = ChildLimits(memory_bytes=2 << 30, wall_s=120, calls_per_child=9)


def child_with(setup, *args: object) -> IsolatedChild:  # type: ignore[no-untyped-def]
    return IsolatedChild(limits=PATIENT, setup=setup, setup_args=args)


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deaths, "_PAUSE_S", 0.0)


@pytest.fixture
def plain_child() -> Iterator[IsolatedChild]:
    plain_child = child_with(called.nothing)
    yield plain_child
    plain_child.close()


def test_a_signal_of_native_code_is_told_from_one_of_somebody_else(
    plain_child: IsolatedChild,
) -> None:
    with pytest.raises(ChildFailed, match="SIGSEGV") as caught:
        plain_child.call(called.die_by, signal.SIGSEGV)
    assert (caught.value.reason, caught.value.is_verdict) == ("crashed_signal_11", True)
    with pytest.raises(ChildFailed, match="SIGTERM") as caught:
        plain_child.call(called.die_by, signal.SIGTERM)
    assert (caught.value.reason, caught.value.is_verdict) == ("killed", False)


@for_each(
    ("number", "reason"),
    [
        (signal.SIGABRT, "crashed_signal_6"),
        (signal.SIGFPE, "crashed_signal_8"),
        (signal.SIGKILL, "killed"),
        (signal.SIGHUP, "killed"),
        (signal.SIGBUS, "killed"),
        (signal.SIGXCPU, "killed"),  # a limit of somebody else: these children have none
    ],
)
def test_ends_by_other_signals_are_told_apart_by_the_status(
    plain_child: IsolatedChild, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, reason: str
) -> None:
    ended = SimpleNamespace(exitcode=-number, join=lambda timeout_s: None)
    monkeypatch.setattr(plain_child, "_process", ended)
    death = plain_child._death()
    assert (death.reason, death.is_verdict) == (reason, reason != "killed")
    assert number.name in death.message


def test_the_same_call_is_made_again(plain_child: IsolatedChild, tmp_path: Path) -> None:
    assert (
        call_with_retries(plain_child, called.count_and_die, str(tmp_path), signal.SIGKILL, 2) == 3
    )


@for_each(("reason", "end"), ENDS.items())
def test_tries_end(reason: str, end: deaths.End) -> None:
    calls: list[str] = []

    def fail() -> None:
        calls.append(reason)
        raise ChildFailed(reason, "as ever")

    with pytest.raises(ChildFailed) as caught:
        with_retries(fail)
    assert (len(calls), caught.value.is_verdict) == (end.tries, end.is_verdict)


def test_every_end_has_tries_and_only_two_are_verdicts() -> None:
    """A verdict may be kept, and lead to other data: whoever adds one must say so here."""
    assert {name for name, end in ENDS.items() if end.is_verdict} == {
        "timeout_cpu",
        "crashed_signal",
    }
    assert all(1 <= end.tries <= 3 for end in ENDS.values())
    tries = {name: ENDS[name].tries for name in ("killed", "exception", "crashed_signal")}
    assert tries == {"killed": 3, "exception": 3, "crashed_signal": 2}
    assert not is_passing("degenerate")


def test_kills_while_a_child_is_set_up_are_tried_again_and_end_the_run_at_last(
    tmp_path: Path,
) -> None:
    with closing(child_with(called.set_up_dying, str(tmp_path), signal.SIGKILL, 2)) as plain_child:
        assert plain_child.call(called.double, 4) == 8
    assert len(list(tmp_path.iterdir())) == 3
    (tmp_path / "again").mkdir()
    plain_child = child_with(called.set_up_dying, str(tmp_path / "again"), signal.SIGKILL, 99)
    with pytest.raises(EnvironmentFailure, match="cannot be set up.*SIGKILL.*doctor"):
        plain_child.call(called.double, 4)
    assert len(list((tmp_path / "again").iterdir())) == 3


def test_a_set_up_that_cannot_succeed_is_tried_once_at_each_call(tmp_path: Path) -> None:
    """And no call is made in a child that was not set up."""
    with closing(child_with(called.fail_set_up, str(tmp_path))) as plain_child:
        for calls in (1, 2):
            with pytest.raises(EnvironmentFailure, match="cannot be set up.*a library is broken"):
                plain_child.call(called.double, 4)
            assert len(list(tmp_path.iterdir())) == calls

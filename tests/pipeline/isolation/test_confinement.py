"""A child that a file has taken over: what it then tries is refused, and reading goes on."""

import os
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, Reach, confinement, reach
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
def test_inputs_are_read_and_outputs_written(child: IsolatedChild, place: Path) -> None:
    assert child.call(called.read, place / "in" / "file") == "in"
    child.call(called.write, place / "out" / "new")
    child.call(called.replace, place / "out" / "file", place / "out" / "new")
    assert (place / "out" / "file").read_text() == "written"


@needs_landlock
def test_a_file_outside_is_not_read(child: IsolatedChild, place: Path) -> None:
    outside = [place / name for name in ("outside/file", "in/link", "in/../outside/file")]
    secrets = Path(f"/proc/{os.getpid()}/environ")  # of another process
    assert child.call(called.refused_paths, [*outside, secrets], False) == [*outside, secrets]


@needs_landlock
def test_nothing_is_written_outside_of_the_output(child: IsolatedChild, place: Path) -> None:
    paths = [place / name for name in ("in/file", "in/new", "outside/file", "new")]
    assert child.call(called.refused_paths, paths, True) == paths
    assert (place / "in" / "file").read_text() == "in"


@needs_seccomp
def test_nothing_is_connected_to(child: IsolatedChild) -> None:
    families = [int(each) for each in (socket.AF_INET, socket.AF_INET6, socket.AF_UNIX)]
    assert child.call(called.refused_sockets, families) == families


@needs_seccomp
def test_no_program_is_started(child: IsolatedChild) -> None:
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

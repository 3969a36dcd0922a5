"""What every test may ask for."""

import json
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from pipeline.renders.mitsuba_variant import llvm_libraries

# No test asserts a time: a crowded machine must not fail what is right.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

ROOT = Path(__file__).parents[1]

BUDGET = json.loads((ROOT / "tests/architecture/budget.json").read_bytes())
"""What lines, words, options and the quick tests' seconds may be (test_budget.py)."""

SLOW_KINDS = {
    "servers": "Prefect, a database, a cluster or a bucket",
    "commands": "what documents tell a reader to type, as processes",
    "every": "every preset, object or example scene, where quick tests take two",
    "training": "networks that learn, are compiled, or train in several processes",
    "benchmarks": "an experiment measured for real",
    "kills": "processes that are killed, stopped or starved",
    "packaging": "the wheel, the site, the machine's own report",
    "references": "pictures and scenes compared with another program's",
    "memory": "sizes at the end of a range, and memory that must stay flat",
    "statistics": "means over many samples or draws",
    "gpu": "steps on a GPU that is not there",
    "hostile": "hundreds of hostile inputs",
    "browser": "a page in headless Chromium",
}
"""The argument of every `slow` mark: why a test cannot be quick; the longest kinds first."""


@pytest.fixture
def bare_reports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the figures out of reports: they take seconds, and tests.documents looks at them."""
    monkeypatch.setattr("pipeline.documents.report.report_sections", lambda found: {})


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real objects, scenes and reference pictures."""
    folder = Path(os.environ.get("TRILIGHT_SHARED", ROOT.parent / "shared"))
    if not (folder / "objects").is_dir():
        pytest.skip(f"no real objects: set TRILIGHT_SHARED ({folder} has no objects/)")
    return folder


MEMORY = Path("/dev/shm")
MEMORY_NEEDED = 4 << 30
"""Bytes; the folders of all quick tests together hold a tenth of it."""


def pytest_configure(config: pytest.Config) -> None:
    """Have the folders of quick tests stand in memory, and name LLVM.

    On a disk a fourth of their time is waiting until what was written is safe. Slow tests stay
    there: theirs hold gigabytes. Dr.Jit loads LLVM when a test's module imports it, before any
    `activate`.
    """
    if config.getoption("markexpr") == "not slow" and _has_room(MEMORY):
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))
    for library in llvm_libraries()[:1]:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(library)


def _has_room(folder: Path) -> bool:
    """Return whether tests may write there, run what they wrote, and fill it."""
    if not os.access(folder, os.W_OK):
        return False
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize >= MEMORY_NEEDED and not found.f_flag & os.ST_NOEXEC


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Check the kinds of slow tests, and have workers begin with the tests that may last long."""
    for item in items:
        for mark in item.iter_markers("slow"):
            if len(mark.args) != 1 or mark.args[0] not in SLOW_KINDS:
                raise pytest.UsageError(
                    f"{item.nodeid}: slow{mark.args}; expected one of {', '.join(SLOW_KINDS)}"
                )
    if config.getoption("markexpr") == "slow":
        items[:] = _order_files(items)
    else:
        workers = getattr(config, "workerinput", {}).get("workercount", 1)
        items[:] = _deal_items(items, workers)


def _order_files(items: list[pytest.Item]) -> list[pytest.Item]:
    """Put files first that may last long; whole files are dealt, for they share servers.

    Among equal timeouts the kind decides: four minutes that come last keep the others waiting.
    """
    kinds = list(SLOW_KINDS)
    longest: dict[Path, tuple[float, int]] = {}
    for item in items:
        found = (_patience_s(item), -len(kinds))
        for mark in item.iter_markers("slow"):
            found = max(found, (_patience_s(item), -kinds.index(mark.args[0])))
        longest[item.path] = max(longest.get(item.path, found), found)
    return sorted(items, key=lambda item: longest[item.path], reverse=True)


def _deal_items(items: list[pytest.Item], workers: int) -> list[pytest.Item]:
    """Deal long tests to the workers first: one that came last kept the others waiting."""
    long = sorted(filter(_patience_s, items), key=_patience_s, reverse=True)
    rest = [item for item in items if not _patience_s(item)]  # in order: they share fixtures
    dealt: list[pytest.Item] = []
    for worker in range(workers):
        first = long[worker::workers]
        room = (len(items) * (worker + 1)) // workers - len(dealt) - len(first)
        dealt += [*first, *rest[:room]]
        rest = rest[room:]
    return [*dealt, *rest]


def _patience_s(item: pytest.Item) -> float:
    """Return the longest timeout that a test or its file states, s."""
    return max((float(mark.args[0]) for mark in item.iter_markers("timeout")), default=0.0)


_SECONDS: list[float] = []
"""Of every quick test of this session, set-up included."""


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Count the seconds of a test, in the process that hears from all workers."""
    _SECONDS.append(report.duration)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where the quick tests together took longer than the budget, and a tenth for noise."""
    config = session.config
    is_whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    is_quick = is_whole and config.getoption("markexpr") == "not slow"
    if is_quick and not hasattr(config, "workerinput"):
        most = 1.1 * BUDGET["quick_test_seconds"]
        if sum(_SECONDS) > most:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
            message = f"quick tests took {sum(_SECONDS):.0f} s, at most {most:.0f}: budget.json"
            config.get_terminal_writer().line(message)

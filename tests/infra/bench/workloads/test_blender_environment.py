"""What the comparison with Cycles does without Blender: finding it."""

from pathlib import Path

import pytest

from infra.bench.workloads import blender_environment as environment
from storage.errors import TrilightError


def test_an_interrupted_installation_does_not_count(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    assert environment.installed_python() is None
    steps: list[str] = []

    def step(name: str, command: list[str]) -> None:
        steps.append(name)
        (tmp_path / "cycles" / f"bpy-{environment.BLENDER}").mkdir(parents=True, exist_ok=True)
        if len(steps) == 2:
            raise TrilightError("no index")

    monkeypatch.setattr(environment, "_base_python", lambda: "python")
    monkeypatch.setattr(environment, "_run", step)
    with pytest.raises(TrilightError):
        environment.blender_python()
    assert environment.installed_python() is None
    assert environment.blender_python() == environment.installed_python()
    assert len(steps) == 2 + 3  # began anew
    environment.blender_python()
    assert len(steps) == 2 + 3  # and is remembered


def test_a_python_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    monkeypatch.setattr(environment, "PYTHON", "3.0")
    with pytest.raises(TrilightError, match=r"^Blender .*python3\.0 is not on the path.*\.$"):
        environment.blender_python()


def test_what_a_failing_step_says_last_is_the_message() -> None:
    with pytest.raises(TrilightError, match=r"^Blender .*could not load it: no such wheel\.$"):
        environment._run("load it", ["sh", "-c", "echo first; echo no such wheel >&2; exit 3"])

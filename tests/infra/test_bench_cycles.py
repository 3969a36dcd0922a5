"""What the comparison with Cycles does without Blender: finding it, and its sums."""

import ast
from pathlib import Path

import pytest

from infra.bench.cycles import environment
from infra.bench.cycles.__main__ import main
from infra.bench.cycles.comparison import (
    CYCLES,
    OURS,
    SceneResult,
    Shot,
    ratio_at_equal_error,
    ratio_at_equal_samples,
)
from storage.errors import TrilightError
from tests.conftest import ROOT


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


def test_only_what_runs_in_blender_imports_it() -> None:
    importing = {
        path.relative_to(ROOT).as_posix()
        for package in ("infra", "pipeline", "storage", "scene_templates", "model", "train")
        for path in (ROOT / package).rglob("*.py")
        if "bpy" in _imports(path)
    }
    scripts = {"infra/bench/cycles/blender_process.py", "infra/blender/exact_materials.py"}
    assert importing == scripts
    ours = {"infra", "pipeline", "storage", "scene_templates", "model", "train"}
    assert not any(_imports(ROOT / script) & ours for script in scripts)


def _imports(path: Path) -> set[str]:
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names.append(node.module or "")
    return {name.split(".")[0] for name in names}


def _shot(renderer: str, spp: int, core_s: float, log_db: float) -> Shot:
    return Shot(
        renderer=renderer,
        spp=spp,
        render_s=core_s,
        core_s=core_s,
        log_db=log_db,
        linear_db=log_db,
        log_db_to_cycles=None,
        linear_db_to_cycles=None,
    )


def test_ratios() -> None:
    shots = (
        _shot(CYCLES, 128, 8.0, 40.0),
        _shot(CYCLES, 1024, 64.0, 46.0),
        _shot(OURS, 128, 2.0, 39.9),
        _shot(OURS, 256, 4.0, 41.0),
        _shot(OURS, 512, 9.0, 43.0),
    )
    result = SceneResult(name="x", num_triangles=1, shots=shots)
    assert ratio_at_equal_samples(result, 128) == 4
    assert ratio_at_equal_samples(result, 1024) is None
    assert ratio_at_equal_error(result, 128) == 2  # 128 of ours are not enough, 512 too many
    assert ratio_at_equal_error(result, 1024) is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"sampled": 0}, "no scene is chosen"),
        ({"our_spp": "100"}, "multiples of 128"),
        ({"cycles_spp": "12,x"}, "samples are"),
        ({"scene": ["nowhere"]}, r"has no nowhere\.json"),
    ],
)
def test_mistakes_are_told_before_anything_is_installed(
    options: dict, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def install() -> Path:
        raise AssertionError("too early")

    monkeypatch.setattr(environment, "blender_python", install)
    scenes = tmp_path if "scene" in options else None
    given = {"scenes": scenes, "sampled": 1, **options}
    with pytest.raises(TrilightError, match=said):
        main(tmp_path / "out.json", **given)

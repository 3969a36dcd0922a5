"""pymeshlab has a licence (GPL) that some cannot take: the stage works without it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.assets.recipe import RECIPE, methods_of
from tests.conftest import ROOT

PROGRAM = """
import importlib.metadata, json, sys
from pathlib import Path

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "pymeshlab" or name.startswith("igl.copyleft"):
            raise ModuleNotFoundError(f"blocked: {name}")

def absent(name, real=importlib.metadata.version):
    if name == "pymeshlab":
        raise importlib.metadata.PackageNotFoundError(name)
    return real(name)

importlib.metadata.version = absent
sys.meta_path.insert(0, Blocked())

from pipeline.assets.prepare import prepare_asset
from pipeline.assets.recipe import RECIPE, methods_of
from pipeline.assets.settings import AssetSettings
from storage.errors import TrilightError

settings = AssetSettings(budgets=(1400, 500))
methods = methods_of("faithful")
attempt = prepare_asset(Path(sys.argv[1]), settings, methods[0])
try:
    methods_of("uniform")
    refusal = ""
except TrilightError as error:
    refusal = str(error)
print(json.dumps({
    "recipe": RECIPE,
    "methods": methods,
    "levels": [(level.record.method, len(level.faces)) for level in attempt.asset.levels],
    "missed": sorted(attempt.missed),
    "refusal": refusal,
    "loaded": [name for name in sys.modules if "pymeshlab" in name and "trilight" not in name],
}))
"""


@pytest.fixture(scope="module")
def told(shared: Path) -> dict:
    """What a process without pymeshlab makes of a real object."""
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(shared / "objects" / "classic" / "spot.obj")],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    answer: dict = json.loads(result.stdout.splitlines()[-1])
    return answer


def test_faithful_works_by_the_other_library(told: dict) -> None:
    assert told["methods"] == ["meshoptimizer", "meshoptimizer_sloppy"]
    assert told["missed"] == []
    for method, faces in told["levels"]:
        assert method == "meshoptimizer"
        assert faces <= 1400
    assert len(told["levels"]) == 2


def test_uniform_says_what_is_missing_and_what_to_do(told: dict) -> None:
    assert "profile uniform" in told["refusal"]
    assert "pymeshlab is not installed" in told["refusal"]
    assert "faithful" in told["refusal"]


def test_the_recipe_says_so_and_nothing_of_it_is_loaded(told: dict) -> None:
    assert "pymeshlab=absent" in told["recipe"]
    assert "pymeshlab=absent" not in RECIPE
    assert told["loaded"] == []
    assert methods_of("faithful")[0] == "pymeshlab_collapse"

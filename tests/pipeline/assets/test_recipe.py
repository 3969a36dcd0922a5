"""What the recipe's name stands for: bytes, libraries, and reasons that a test earns."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.assets.recipe import RECIPE, methods_of
from pipeline.assets.settings import AssetSettings
from pipeline.generation.environment import vector_extension
from pipeline.generation.prepare_isolated import prepare_isolated
from pipeline.objects.generated import generate_objects
from storage.digests import canonical_json, sha256_hex
from tests.conftest import ROOT

OUTCOMES = {
    ("assets-2", "avx512f"): "5afad93969b7792c2f6bd9a9c333e9e1de192fc769affbb6323b3d82ea48ea61"
}
"""Digest of what became of four built-in objects, by recipe and processor."""


def test_an_outcome_changes_only_with_the_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    records = generate_objects("builtin:4", tmp_path)
    settings = AssetSettings(budgets=(340, 240))
    prepared, failures = prepare_isolated(records, settings, workers=1, done=lambda: None)
    outcomes = [[asset.record.uid, asset.asset_sha256] for asset in prepared]
    digest = sha256_hex(canonical_json([outcomes, [failure.reason for failure in failures]]))
    known = OUTCOMES.get((RECIPE.split()[0], vector_extension()), digest)
    assert digest == known, "raise the number in pipeline/assets/recipe.py, and add a row here"


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


def test_faithful_works_without_pymeshlab_and_uniform_says_what_to_do(shared: Path) -> None:
    """In a process without it, of a real object; the recipe says so, and nothing is loaded."""
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(shared / "objects" / "classic" / "spot.obj")],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    told = json.loads(result.stdout.splitlines()[-1])
    assert told["methods"] == ["libigl_qslim", "meshoptimizer", "meshoptimizer_sloppy"]
    assert [method for method, _ in told["levels"]] == ["libigl_qslim"] * 2
    assert max(faces for _, faces in told["levels"]) <= 1400
    assert (told["missed"], told["loaded"]) == ([], [])
    assert re.search("profile uniform.*faithful", told["refusal"])
    assert "pymeshlab is not installed" in told["refusal"]
    assert told["recipe"] == "assets-3 libigl" != RECIPE
    assert methods_of("faithful")[0] == "pymeshlab_collapse"


_RAISED = re.compile(r'Rejected\(\s*"([a-z_]+)"')
_FAILED = re.compile(r'ChildFailed\(\s*f?"([a-z_]+?)(?:_\{|")')
_ANSWERED = re.compile(r'encode_error\("((?!rejected)[a-z_]+)"')
_CHOSEN = re.compile(r'reason = "([a-z_]+)" if [^\n]+ else "([a-z_]+)"')


def codes() -> set[str]:
    """Return every reason that the stage or its children can give, as their sources have them."""
    found: set[str] = set()
    folders = (ROOT / "pipeline" / name for name in ("assets", "foreign"))
    for path in (path for folder in folders for path in folder.rglob("*.py")):
        text = path.read_text()
        found.update(_RAISED.findall(text))
        found.update(code for pair in _CHOSEN.findall(text) for code in pair)
    isolation = "".join(p.read_text() for p in (ROOT / "pipeline" / "isolation").glob("*.py"))
    found.update(_FAILED.findall(isolation))
    found.update(_ANSWERED.findall(isolation))
    return found


def test_every_code_is_read_from_the_sources_and_named_by_a_test() -> None:
    known = {"no_faces", "index_range", "parts_lost", "timeout_cpu", "crashed_signal", "exception"}
    assert known < codes()
    assert len(codes()) > 35
    texts = [
        path.read_text()
        for folder in ("pipeline", "extremes")
        for path in (ROOT / "tests" / folder).rglob("test_*.py")
        if path.name != "test_recipe.py"
    ]
    named = {code for code in codes() if any(re.search(rf"\b{code}(\b|_\d)", t) for t in texts)}
    assert codes() - named == set()

"""From a file to an asset: the laws that hold whatever the file says, of real objects too."""

import hashlib
import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.assets.cleaning.clean import GRID
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.quality.measure import Surface, level_mesh
from pipeline.assets.recipe import RECIPE, methods_of
from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.foreign.mesh import TriangleMesh
from pipeline.generation.prepare_isolated import mesh_stage
from pipeline.objects.generated import generate_objects
from pipeline.objects.sources import list_objects
from pipeline.presets.registry import preset_settings
from pipeline.renders.mitsuba_variant import vector_extension
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.asset import Asset, encode_asset
from storage.records.objects import ObjectRecord
from tests.conftest import ROOT
from tests.for_each import for_each
from tests.pipeline.assets import meshes_by_hand as meshes
from tests.pipeline.programs import printed_by

SMALL = meshes.knot(segments=80)


@pytest.fixture(scope="module")
def asset(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """A knot of 1920 faces: every level needs decimation."""
    return meshes.prepare(meshes.write_obj(tmp_path_factory.mktemp("knot") / "knot.obj", SMALL))


def test_every_budget_is_kept_and_used_and_the_error_holds_on_other_points(asset: Asset) -> None:
    meshes.check_levels(asset)
    assert [level.record.budget for level in asset.levels] == list(AssetSettings().budgets)
    source, _ = orient_outward(meshes.cleaned(SMALL))
    surface = Surface(source, np.random.default_rng(99).random((8192, 3)))
    for level in asset.levels:
        # pymeshlab collapses edges, which take two faces each: it stops at most one short.
        assert level.record.budget - 1 <= len(level.faces)
        deviation = surface.hausdorff_deviation(level_mesh(level))
        for way in (deviation.to_other, deviation.from_other):
            # The recorded percentile comes from 8192 points: its rank is known to 0.33 % (3 sigma).
            assert np.percentile(way, 98.6) <= level.record.quality.error_p99


def test_a_source_within_budget_is_kept_once_as_it_is(tmp_path: Path) -> None:
    ball = meshes.sphere(rings=13, columns=24)
    asset = meshes.prepare(meshes.write_obj(tmp_path / "a.obj", ball))
    assert [level.record.budget for level in asset.levels] == [1400, 500, 340, 240]
    first = asset.levels[0]
    assert (first.record.method, len(first.faces)) == ("source", 624)
    # Points are interpolated and projected in double precision, on a surface of size 1.
    assert first.record.quality.error_max < 1e-14


def test_formats_agree_and_buffers_beside_a_gltf_are_read_and_counted(tmp_path: Path) -> None:
    """The same single precision numbers in six formats give the same asset."""
    mesh = meshes.knot(segments=40)
    positions = mesh.positions.astype(np.float32).astype(np.float64)
    single = TriangleMesh(positions=positions, faces=mesh.faces)
    paths = [write(tmp_path / f"a{suffix}", single) for suffix, write in meshes.WRITERS.items()]
    tree, buffer = meshes.gltf_tree(single)
    paths.append(meshes.write_glb(tmp_path / "a.glb", tree, buffer))
    tree["buffers"][0]["uri"] = "data/its%20own.bin"
    (tmp_path / "data").mkdir()
    beside = tmp_path / "data" / "its own.bin"
    beside.write_bytes(buffer)
    paths.append(tmp_path / "a.gltf")
    paths[-1].write_text(json.dumps(tree))
    assets = [meshes.prepare(path, AssetSettings(budgets=(500,))) for path in paths]
    assert len({asset.geometry_sha256 for asset in assets}) == 1
    assert len({meshes.geometry(asset) for asset in assets}) == 1
    assert len({asset.source_sha256 for asset in assets}) == len(assets)
    beside.write_bytes(bytes([buffer[0] ^ 1]) + buffer[1:])
    assert meshes.prepare(paths[-1]).source_sha256 != assets[-1].source_sha256


def test_two_processes_write_the_same_bytes(tmp_path: Path, asset: Asset) -> None:
    path = meshes.write_obj(tmp_path / "knot.obj", SMALL)
    code = (
        "import hashlib, sys; from storage.records.asset import encode_asset;"
        "from tests.pipeline.assets.meshes_by_hand import prepare; from pathlib import Path;"
        "asset = prepare(Path(sys.argv[1]));"
        "print(hashlib.sha256(encode_asset(asset)).hexdigest())"
    )
    digest = printed_by(code, str(path), OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    assert digest == hashlib.sha256(encode_asset(asset)).hexdigest()


def test_what_the_parent_needs_loads_no_mesh_library() -> None:
    code = (
        "import sys, pipeline.assets.settings, pipeline.assets.recipe, pipeline.assets.stage,"
        "pipeline.assets.asset_store, pipeline.foreign.source_file;"
        "print(*sys.modules)"
    )
    heavy = {"trimesh", "igl", "pymeshlab", "embreex", "wasmtime"}
    assert not heavy & set(printed_by(code).split())


NO_SETTINGS: list[dict[str, Any]] = [
    {"budgets": ()}, {"budgets": (500, 500)}, {"budgets": (500, 700)}, {"profile": "fast"},
    {"epsilon": 0.04},
]  # fmt: skip
NO_GATES: list[dict[str, Any]] = [{"area_ratio": (1.1, 1.2)}, {"area_ratio": (0.8, 1.0)}]
"""Laws between numbers, and words; the ends of every range are those of tests/extremes."""


def test_settings_without_meaning_are_refused() -> None:
    for kind, wrong in ((AssetSettings, NO_SETTINGS), (GateSettings, NO_GATES)):
        for values in wrong:
            with pytest.raises(TrilightError, match=next(iter(values))):
                kind(**values)


TWO_LEVELS = AssetSettings(budgets=(1000, 500))


@for_each(
    ("method", "scale", "offset"),
    [("pymeshlab_collapse", 1e-6, (-100, 3, 0.7)), ("meshoptimizer", 0.7e6, (50, -80, 20))],
)
def test_any_scale_place_and_winding_give_the_same_bytes(
    tmp_path: Path, method: str, scale: float, offset: tuple[float, float, float]
) -> None:
    """Offsets are in extents: text keeps 17 digits, which leaves 1e-13 of the object here."""
    source = meshes.knot(segments=60)
    plain = meshes.prepare(meshes.write_obj(tmp_path / "a.obj", source), TWO_LEVELS, method)
    elsewhere = meshes.moved(meshes.moved(source, 1.0, offset), scale)
    elsewhere = meshes.flip_some(elsewhere, 0.3, np.random.default_rng(5))
    again = meshes.prepare(meshes.write_obj(tmp_path / "b.obj", elsewhere), TWO_LEVELS, method)
    assert meshes.geometry(again) == meshes.geometry(plain)
    assert again.geometry_sha256 == plain.geometry_sha256
    assert again.levels[0].record.quality == plain.levels[0].record.quality


def test_any_turn_keeps_budgets_and_surfaces(tmp_path: Path) -> None:
    """Turn, then prepare; or prepare, then turn: both are near the same source.

    Bytes cannot agree: the unit box and its grid have the axes of the file, and edges of equal
    cost collapse in an order that follows the coordinates.
    """
    turn = Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix()
    sources = [TriangleMesh(positions=meshes.knot().positions @ m, faces=meshes.knot().faces)
               for m in (np.eye(3), turn)]  # fmt: skip
    made = [
        meshes.prepare(meshes.write_obj(tmp_path / "a.obj", source), TWO_LEVELS)
        for source in sources
    ]
    for levels in zip(*(asset.levels for asset in made), strict=True):
        placed = []
        # Both boxes add half a cell of rounding in every coordinate.
        bound = 2 * np.sqrt(3) / GRID * sources[1].diagonal
        for level, source in zip(levels, sources, strict=True):
            assert level.record.budget - 1 <= len(level.faces) <= level.record.budget
            low, high = source.positions.min(axis=0), source.positions.max(axis=0)
            placed.append(meshes.moved(level_mesh(level), (high - low).max(), (low + high) / 2))
            bound += level.record.quality.error_p99 * source.diagonal
        expected = TriangleMesh(positions=placed[0].positions @ turn, faces=placed[0].faces)
        uniform = np.random.default_rng(0).random((8192, 3))
        deviation = Surface(expected, uniform).hausdorff_deviation(placed[1])
        # By the triangle inequality, all but 1 % + 1 % of the points are within the sum.
        assert deviation.two_way(98) * expected.diagonal <= bound


LICENCES = ("CC0-1.0", "LicenseRef-unknown", "LicenseRef-Stanford-3D-Scanning-Repository")


@pytest.fixture(scope="module")
def records(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> list[ObjectRecord]:
    """All that the catalogue lists, whatever their licences: nothing is made of them here."""
    source, work_dir = str(shared / "objects"), tmp_path_factory.mktemp("work")
    listed = list_objects(source, work_dir=work_dir, allowed_licences=LICENCES)
    return listed.fetch_selected().records


@pytest.mark.parametrize("step", [27, pytest.param(2, marks=pytest.mark.slow("every"))])
def test_a_cross_section_of_them(records: list[ObjectRecord], step: int) -> None:
    """A scan among them; of the other half tests/end_to_end/test_identity.py holds the bytes."""
    assert len(records) == 148
    for record in records[step // 2 :: step]:
        meshes.check_levels(meshes.prepare(Path(record.path)))


def test_copies_in_other_colours_share_their_geometry(records: list[ObjectRecord]) -> None:
    digests = {
        record.uid: meshes.prepare(Path(record.path)).geometry_sha256
        for record in records
        if "/banner_pattern" in record.uid or "/bottle_" in record.uid
    }
    # Pattern A in four colours; B and C, which differ in their texture only, in seven together;
    # bottles A (three), B and C (two each).
    assert sorted(Counter(digests.values()).values()) == [2, 2, 3, 4, 7]


OUTCOMES = {
    ("assets-2", "avx512f"): "5afad93969b7792c2f6bd9a9c333e9e1de192fc769affbb6323b3d82ea48ea61"
}
"""Digest of what became of four built-in objects, by recipe and processor."""


def test_an_outcome_changes_only_with_the_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    records = generate_objects("builtin:4", tmp_path)
    two = AssetSettings(budgets=(340, 240))
    with mesh_stage(two, workers=1) as prepare:
        prepared, failures = prepare(records, lambda: None)
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
    output = printed_by(PROGRAM, str(shared / "objects" / "classic" / "spot.obj"))
    told = json.loads(output.splitlines()[-1])
    assert told["methods"] == ["libigl_qslim", "meshoptimizer", "meshoptimizer_sloppy"]
    assert [method for method, _ in told["levels"]] == ["libigl_qslim"] * 2
    assert max(faces for _, faces in told["levels"]) <= 1400
    assert (told["missed"], told["loaded"]) == ([], [])
    assert re.search("profile uniform.*pymeshlab is not installed.*faithful", told["refusal"])
    assert told["recipe"] == "assets-3 libigl" != RECIPE
    assert methods_of("faithful")[0] == "pymeshlab_collapse"
    decimator = preset_settings("pretrain-256").assets.decimator
    assert methods_of("faithful", decimator) == tuple(told["methods"])


_REASONS = (
    ("assets foreign", r'Rejected\(\s*"([a-z_]+)"'),
    ("assets foreign", r'reason = "([a-z_]+)" if [^\n]+ else "[a-z_]+"'),
    ("assets foreign", r'reason = "[a-z_]+" if [^\n]+ else "([a-z_]+)"'),
    ("isolation", r'ChildFailed\(\s*f?"([a-z_]+?)(?:_\{|")'),
    ("isolation", r'encode_error\("((?!rejected)[a-z_]+)"'),
)
"""Folders of the pipeline, and how their sources give a reason."""


def test_every_code_is_read_from_the_sources_and_named_by_a_test() -> None:
    codes = {
        code
        for folders, pattern in _REASONS
        for folder in folders.split()
        for path in (ROOT / "pipeline" / folder).rglob("*.py")
        for code in re.findall(pattern, path.read_text())
    }
    known = {"no_faces", "index_range", "parts_lost", "timeout_cpu", "crashed_signal", "exception"}
    assert known < codes
    assert len(codes) > 35
    texts = [
        path.read_text()
        for folder in ("pipeline", "extremes")
        for path in (ROOT / "tests" / folder).rglob("test_*.py")
        if path.name != "test_prepare.py"
    ]
    named = {code for code in codes if any(re.search(rf"\b{code}(\b|_\d)", t) for t in texts)}
    assert codes - named == set()

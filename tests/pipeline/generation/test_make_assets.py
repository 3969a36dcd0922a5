"""`trilight assets`, from real objects and broken ones to a folder that is a source of objects."""

import csv
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import trimesh

from infra.cli import assets
from pipeline.assets.settings import AssetSettings, OwnMaterialSettings
from pipeline.generation.make_assets import AssetFolder, AssetReport, make_assets
from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.objects.sources import list_objects
from storage.errors import TrilightError
from storage.records.objects import read_failures
from tests.command_line import expect_json, expect_mistake, expect_output, trilight
from tests.for_each import case
from tests.pipeline.assets.meshes_by_hand import cube, sphere, write_obj
from tests.pipeline.documents.dataset_by_hand import files_of

REAL = (
    "classic/suzanne.obj",
    "classic/teapot.obj",
    "kaykit_dungeon/floor_dirt_small_B.gltf.glb",
    "kaykit_dungeon/floor_tile_small_corner.gltf.glb",
)
BUDGET = 1000
WHOLE = AssetSettings(budgets=(100_000,))
"""Nothing is decimated: quick, where a test is about something else."""
BAD = {
    "bad/empty.obj": (b"", "no_faces"),
    "bad/noise.stl": (bytes(range(256)) * 4, "header_size_mismatch"),
    "bad/zip.ply": (b"PK\x03\x04" + bytes(50), "archive_refused"),
}


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A store of our own, for children too: mesh libraries may ruin the memory of a process."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRILIGHT_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="module")
def source(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    for name in REAL:
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(shared / "objects" / name, folder / name)
    with (folder / REAL[0]).open("a") as stream:
        stream.write("\ncurv 0 1 1 2\n")
    (folder / "bad").mkdir()
    for name, (data, _) in BAD.items():
        (folder / name).write_bytes(data)
    return folder


def run(
    source: Path | str, out: Path, settings: AssetSettings | None = None, workers: int = 1
) -> AssetReport:
    counts: list[int] = []
    report = make_assets(
        str(source),
        AssetFolder(out),
        settings or AssetSettings(budgets=(BUDGET,)),
        allowed_licences=DEFAULT_ALLOWED,
        licence=None,
        workers=workers,
        on_download=lambda done, total: pytest.fail("these sources lie on this machine"),
        on_plan=counts.append,
        on_object=lambda: counts.append(-1),
    )
    planned, *steps = counts
    assert steps == [-1] * planned
    return report


@pytest.fixture(scope="module")
def made(source: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, AssetReport]:
    out = tmp_path_factory.mktemp("made") / "out"
    return out, run(source, out, workers=2)


def test_every_object_has_its_outcome_in_every_document_and_meshes_open_elsewhere(
    made: tuple[Path, AssetReport],
) -> None:
    out, report = made
    assert len(report.rows) == len(REAL)
    assert [failure.reason for failure in report.failures] == [why for _, why in BAD.values()]
    for row in report.rows:
        assert 1 <= row.num_faces <= BUDGET
        assert row.quality.error_p99 <= 0.03
        assert (row.method == "source") == (row.source.num_faces <= BUDGET)
        mesh = trimesh.load_mesh(out / row.path, process=False)
        assert len(mesh.faces) == row.num_faces
        # The box of the source is 1 wide; a vertex may leave it by 1 % of its diagonal.
        assert mesh.extents.max() == pytest.approx(1, abs=2 * 0.01 * 3**0.5)
    assert any(row.method != "source" for row in report.rows)
    assert set(read_failures(AssetFolder(out).failures)) == set(report.failures)
    summary = json.loads(AssetFolder(out).summary.read_bytes())
    assert (summary["accepted"], summary["rejected"]) == (len(REAL), len(BAD))
    with AssetFolder(out).attribution.open(newline="") as stream:
        assert [row["uid"] for row in csv.DictReader(stream)] == [row.uid for row in report.rows]
    page = AssetFolder(out).page.read_text()
    for row in report.rows:
        assert row.uid in page
    assert page.count("header_size_mismatch") == 1
    unread = {"classic/suzanne": ("statement 'curv'",)}
    assert report.unread == unread and "Not read" in page
    logged = json.loads((AssetFolder(out).logs / "unread.json").read_bytes())
    assert logged == {"classic/suzanne": ["statement 'curv'"]}
    assert not list(out.rglob("*.part"))


def test_the_folder_is_a_source_of_objects_and_is_made_the_same_again(
    made: tuple[Path, AssetReport], source: Path, tmp_path: Path
) -> None:
    out, report = made
    listed = list_objects(str(out), work_dir=tmp_path, allowed_licences=DEFAULT_ALLOWED)
    found = listed.fetch_selected()
    assert not found.failures
    assert [record.uid for record in found.records] == [row.uid for row in report.rows]
    for record, row in zip(found.records, report.rows, strict=True):
        for field in ("title", "licence", "licence_source", "attribution", "source_url"):
            assert getattr(record, field) == getattr(row, field)
    again = run(out, tmp_path / "again")
    assert [row.num_faces for row in again.rows] == [row.num_faces for row in report.rows]
    assert {row.method for row in again.rows} == {"source"}
    before = files_of(out)
    assert run(source, out) == report
    assert files_of(out) == before


def test_objects_that_are_gone_leave_no_mesh(source: Path, tmp_path: Path) -> None:
    out, objects = tmp_path / "out", tmp_path / "objects"
    shutil.copytree(source / "bad", objects / "bad")
    for number in range(2):
        write_obj(objects / f"{number}.obj", sphere(5, 6 + number))
    assert len(run(objects, out, WHOLE).rows) == 2
    (objects / "0.obj").unlink()
    shutil.rmtree(objects / "bad")
    (row,) = run(objects, out, WHOLE).rows
    assert [path.name for path in (out / "meshes").iterdir()] == [Path(row.path).name]
    assert read_failures(out / "failures.jsonl") == []
    assert len((out / "objects.jsonl").read_text().splitlines()) == 1


def test_names_from_outside_make_safe_file_names(tmp_path: Path) -> None:
    """Names that differ in odd letters only stay apart; none leads out of the folder."""
    folder = tmp_path / "source"
    folder.mkdir()
    names = ["a b.obj", "a_b.obj", "=1+1.obj", "-rf.obj", "ä" * 60 + ".obj"]
    for number, name in enumerate(names):
        write_obj(folder / name, sphere(5, 6 + number))
    report = run(folder, tmp_path / "out", WHOLE)
    files = [path.name for path in (tmp_path / "out" / "meshes").iterdir()]
    assert len(files) == len(report.rows) == len(names)
    for name in files:
        assert re.fullmatch(r"[A-Za-z0-9-]*[0-9a-f]{8}\.ply", name)


def test_a_folder_of_somebody_else_is_left_alone(source: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(TrilightError, match="did not write"):
        run(source, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(TrilightError, match="is a file; expected a folder"):
        run(source, tmp_path / "thesis.tex")


@pytest.fixture(scope="module")
def few(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One good object and the bad ones."""
    folder = tmp_path_factory.mktemp("few")
    shutil.copytree(source / "bad", folder / "bad")
    shutil.copy(source / "classic" / "suzanne.obj", folder)
    return folder


def test_the_command_prints_json_and_nothing_else(few: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    answer = expect_json("assets", few, "--out", out, "--budget", "500")
    assert (answer["accepted"], answer["rejected"]) == (1, len(BAD))
    (row,) = answer["objects"]
    assert row["num_faces"] <= 500
    assert {failure["reason"] for failure in answer["failures"]} == {why for _, why in BAD.values()}
    assert (out / "quality.html").exists()


def test_where_nothing_can_be_used_the_command_says_so_and_makes_a_folder_too(
    few: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    result = trilight(["assets", str(few / "bad"), "--out", str(out)])
    assert result.exit_code == 1 and "No object can be used" in result.stdout
    assert "object outcome triangles p99 method or reason" in " ".join(result.stdout.split())
    assert "Next:" not in result.stdout
    assert (out / "objects.jsonl").read_bytes() == b""
    assert len(read_failures(out / "failures.jsonl")) == len(BAD)
    assert (out / "quality.html").read_text().count("<img") == 0


@pytest.mark.slow("kills")
def test_the_command_for_people(few: Path, tmp_path: Path) -> None:
    """Epsilon as a share in percent; the table names what was refused."""
    out = tmp_path / "out"
    assert "archive_refused" in expect_output("assets", few, "--out", out, "--epsilon", "1%")
    (row,) = (json.loads(line) for line in (out / "objects.jsonl").read_text().splitlines())
    assert row["quality"]["error_p99"] <= 0.01
    assert row["num_faces"] < 0.9 * row["source"]["num_faces"]


def test_a_mistake_is_one_line(tmp_path: Path) -> None:
    write_obj(tmp_path / "a.obj", cube())
    wrong = {"--epsilon": "half", "--budget": "0", "--profile": "fast", "--licence": "not one"}
    for option in wrong.items():
        said = expect_mistake("assets", tmp_path, "--out", tmp_path / "out", *option)
        assert option[1] in said, option
        assert not (tmp_path / "out/objects.jsonl").exists(), option


def test_epsilons_are_shares_or_percent() -> None:
    def settings(epsilon: str) -> AssetSettings:
        options = assets.AssetOptions(source="builtin:", out=Path("a"), epsilon=epsilon)
        return assets._settings(options)

    for text in ("half", "9", "-1%", "nan", "inf", "0", "%", "1%%", "5 %."):
        with case(text), pytest.raises(TrilightError, match="epsilon is"):
            settings(text)
    for text, share in (("0.5%", 0.005), ("0.005", 0.005), (" 1 %", 0.01)):
        # One division in double precision.
        assert settings(text).epsilon == pytest.approx(share, rel=1e-15)
        assert settings(text).budgets == (4096,)


@pytest.mark.slow("kills")
def test_own_materials_make_textured_meshes_and_pictures(source: Path, tmp_path: Path) -> None:
    settings = AssetSettings(budgets=(100_000,), own_materials=OwnMaterialSettings(keep=True))
    folder, out = tmp_path / "few", tmp_path / "out"
    shutil.copytree(source / "kaykit_dungeon", folder)
    shutil.copy(source / "classic" / "suzanne.obj", folder)
    report = run(folder, out, settings)
    textured = [row for row in report.rows if row.colours is not None]
    assert len(textured) == 2 and all(row.path.endswith(".glb") for row in textured)
    (plain,) = (row for row in report.rows if row.colours is None)
    assert plain.materials is not None and plain.materials.reason == "no_materials"
    assert plain.path.endswith(".ply")
    page = (out / "quality.html").read_text()
    assert "In their own materials: 2 of 3; the others: no_materials (1)." in page
    again = run(out, tmp_path / "again", settings)
    assert again.geometry_sha256 == report.geometry_sha256
    assert sum(row.colours is not None for row in again.rows) == 2
    plain_keys = run(folder, out, WHOLE).rows[0].as_json().keys()
    assert plain_keys == report.rows[0].as_json().keys() - {"materials", "colours"}
    assert not list((out / "meshes").glob("*.glb"))

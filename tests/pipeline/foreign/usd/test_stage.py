"""USD files of strangers: too large, cut or of another folder; tests/hostile has the rest."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from pipeline.exchange.usd.write_usd import write_usd
from pipeline.foreign.usd import placed
from pipeline.foreign.usd import stage as opening
from pipeline.foreign.usd.stage import OpenedStage, read_quietly
from pipeline.foreign.usd.texture_nodes import asset_bytes
from storage.errors import TrilightError
from tests.hostile.cases import HEAD, paired_arcs
from tests.scenes_by_hand import tiny_scene


def prims_of(opened: OpenedStage) -> list[str]:
    with read_quietly(opened.path):
        stage = opened.compose()
    return [str(prim.GetPath()) for prim in stage.Traverse()]


@pytest.mark.parametrize("packed", [False, True])
def test_brackets_in_the_name_of_a_folder_are_no_archive(tmp_path: Path, packed: bool) -> None:
    folder = tmp_path / "chairs [old]"
    folder.mkdir()
    layers = {
        "s.usda": f'{HEAD}def "x" (references = @./lib.usda@</A>) {{}}',
        "lib.usda": f'{HEAD}def "A" {{\ndef "L" {{}}\n}}',
    }
    if packed:
        with zipfile.ZipFile(folder / "s.usdz", "w") as archive:
            for name, text in layers.items():
                archive.writestr(name, text)
    else:
        for name, text in layers.items():
            (folder / name).write_text(text)
    library = "s.usdz[lib.usda]" if packed else "lib.usda"
    assert asset_bytes(f"{folder}/{library}", 100) == layers["lib.usda"].encode()
    opened = OpenedStage(folder / ("s.usdz" if packed else "s.usda"))
    assert prims_of(opened) == ["/x", "/x/L"]
    assert opened.files == [opened.path, *([] if packed else [folder / "lib.usda"])]


def test_a_compressed_picture_of_another_archive_is_read(tmp_path: Path) -> None:
    """Archives whose layers are opened may hold none; one that only has pictures may."""
    with zipfile.ZipFile(tmp_path / "pictures.usdz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.png", b"packed")
    name = f"{tmp_path}/pictures.usdz[a.png]"
    assert asset_bytes(name, 6) == b"packed"
    with pytest.raises(TrilightError, match="6 bytes; expected at most 5"):
        asset_bytes(name, 5)


def test_the_user_may_name_the_folder_and_the_stage_is_compared_with_it_at_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second lock, should USD learn a way to name files that its own list of names lacks."""
    (tmp_path / "shared.usda").write_text(f'{HEAD}def "A" {{}}')
    folder = tmp_path / "inner"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)  # which is no place to look
    (folder / "a.usda").write_text(f'{HEAD}def "A" (references = @shared.usda@</A>) {{}}')
    with pytest.raises(TrilightError, match="^a.usda: .*outside of its folder"):
        prims_of(OpenedStage(folder / "a.usda"))
    (folder / "a.usda").write_text(f'{HEAD}def "A" (references = @../shared.usda@</A>) {{}}')
    stage = OpenedStage(folder / "a.usda", tmp_path).compose()
    assert len(list(stage.Traverse())) == 1
    monkeypatch.setattr(OpenedStage, "_open_all", lambda self: None)
    with pytest.raises(TrilightError, match="uses 'shared.usda' of another folder"):
        prims_of(OpenedStage(folder / "a.usda"))


def test_what_is_missing_is_noted(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text(f'{HEAD}def "A" (references = @./no.usda@</A>) {{}}')
    opened = OpenedStage(tmp_path / "a.usda")
    prims_of(opened)
    assert opened.lost == ["file './no.usda' is missing"]


def test_sizes_are_looked_at_first(tmp_path: Path) -> None:
    with (tmp_path / "a.usdc").open("wb") as stream:
        stream.truncate(opening.MAX_FILE_BYTES + 1)  # a hole: it takes no room
    with pytest.raises(TrilightError, match="expected a file of 1 to"):
        OpenedStage(tmp_path / "a.usdc")
    (tmp_path / "b.usda").touch()
    with pytest.raises(TrilightError, match="0 bytes"):
        OpenedStage(tmp_path / "b.usda")
    with pytest.raises(TrilightError, match="cannot be read"):
        OpenedStage(tmp_path / "absent.usda")


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_cut_files(tmp_path: Path, suffix: str) -> None:
    whole = tmp_path / f"a{suffix}"
    write_usd(whole, tiny_scene())
    data = whole.read_bytes()
    for kept in np.linspace(1, len(data) - 30, 9).astype(int):
        cut = tmp_path / f"cut{kept}{suffix}"
        cut.write_bytes(data[:kept])
        with pytest.raises(TrilightError, match="^cut"):
            OpenedStage(cut)


def test_exactly_what_composition_makes_is_counted_and_one_prototype_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More bombs are in `tests/hostile`."""
    arcs = f'{HEAD}{paired_arcs(16)}def "A16" {{}}\ndef "B16" {{}}\n'
    (tmp_path / "bomb.usda").write_text(arcs)
    with pytest.raises(TrilightError, match="too many arcs meet in one prim"):
        prims_of(OpenedStage(tmp_path / "bomb.usda"))
    (tmp_path / "b.usda").write_text(
        f'{HEAD}def "P" {{\ndef "a" {{}}\ndef "b" {{}}\n}}\n'
        'def "Q" (references = </P>) {\ndef "c" (references = </P>) {}\n}\n'
        'def "R" (inherits = </Q>) {\nover "c" {\ndef "d" {}\n}\n}\n'
    )
    monkeypatch.setattr(opening, "MAX_PRIMS", 17)  # with the root of all
    assert len(prims_of(OpenedStage(tmp_path / "b.usda"))) == 16
    monkeypatch.setattr(opening, "MAX_PRIMS", 16)
    with pytest.raises(TrilightError, match="more than 16 prims"):
        prims_of(OpenedStage(tmp_path / "b.usda"))
    inner = "".join(f'def "c{i}" {{}}\n' for i in range(50))
    heir = 'def "I{}" (instanceable = true\nreferences = </P>) {{}}\n'
    heirs = "".join(map(heir.format, range(50)))
    (tmp_path / "i.usda").write_text(f'{HEAD}def "P" {{\n{inner}}}\n{heirs}')
    monkeypatch.setattr(opening, "MAX_PRIMS", 1 + 51 + 50 + 50)
    prims_of(OpenedStage(tmp_path / "i.usda"))


def stage_of(prototype: str, count: int) -> Usd.Stage:
    """Return a stage with one instancer."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    instancer = UsdGeom.PointInstancer.Define(stage, "/many")
    UsdGeom.Mesh.Define(stage, "/many/mesh")
    instancer.CreatePrototypesRel().AddTarget(prototype)
    instancer.CreateProtoIndicesAttr([0] * count)
    instancer.CreatePositionsAttr([(index, 0, 0) for index in range(count)])
    return stage


def test_instances_stand_in_their_order_and_too_many_are_refused_before_their_places_are_computed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An instancer within itself is refused: every level would hold the places of its instances."""
    lost: list[str] = []
    found = placed.placed_prims(stage_of("/many/mesh", 3), Usd.TimeCode.Default(), lost)
    assert [each.to_world[0, 3] for each in found] == [0, 1, 2]
    with pytest.raises(TrilightError, match="/many: nested more than 150 deep"):
        placed.placed_prims(stage_of("/many", 2), Usd.TimeCode.Default(), [])
    monkeypatch.setattr(placed, "MAX_PLACED", 4)
    with pytest.raises(TrilightError, match="/many: 5 instances; expected at most 4"):
        placed.placed_prims(stage_of("/many/mesh", 5), Usd.TimeCode.Default(), [])

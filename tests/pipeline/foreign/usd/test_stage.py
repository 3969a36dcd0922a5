"""USD files of strangers: what is outside, circular, too large or broken is one clear line."""

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
from tests.for_each import for_each
from tests.hostile.cases import HEAD, chain, paired_arcs
from tests.scenes_by_hand import tiny_scene


def prims_of(opened: OpenedStage) -> list[str]:
    with read_quietly(opened.path):
        stage = opened.compose()
    return [str(prim.GetPath()) for prim in stage.Traverse()]


VARIANT = (
    'def "A" (variantSets = "v") {\nvariantSet "v" = {\n"x" (references = @../x.usda@) {}\n}\n}'
)
ARGUMENTS = "SDF_FORMAT_ARGS:x=1"
CLIPS = 'def "A" (clips = {dictionary default = {asset[] assetPaths = [@/x.usda@]}}) {}'


@for_each(
    "text, message",
    [
        ('def "A" (references = @https://x.y/z.usda@</A>) {}', "nothing is fetched"),
        (VARIANT, "outside of its folder"),
        ('def "A" (references = </B>) {}\ndef "B" (references = </A>) {}', "in a circle"),
        (CLIPS, "value clips"),
        ('def "A" (references = @x.usda@</A>) {}', "outside of its folder"),
        ('def "A" (references = @./link.usda@</A>) {}', "outside of its folder"),
        ('def "A" (references = @./odd.usda@</A>) {}', "'./odd.usda', which is no plain file"),
        ('def "A" (payload = @`"../x.usda"`@</A>) {}', "a variable expression; expected a name"),
        (f'def "A" (references = @./x.usda:{ARGUMENTS}@</A>) {{}}', "arguments for its file"),
        ('def "A" {', "not readable as USD"),
        ("\0\1\2", "not readable as USD"),
    ],
)
def test_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    """`tests/hostile` leads out in more ways; here each way of refusing says what it is."""
    (tmp_path / "x.usda").write_text(HEAD)  # it is there, and must not be read
    monkeypatch.chdir(tmp_path)  # which is no place to look
    folder = tmp_path / "inner"
    (folder / "odd.usda").mkdir(parents=True)
    (folder / "link.usda").symlink_to(tmp_path / "x.usda")
    (folder / "file.usda").write_text(HEAD + text)
    with pytest.raises(TrilightError, match=message) as caught:
        prims_of(OpenedStage(folder / "file.usda"))
    assert "\n" not in str(caught.value) and str(tmp_path) not in str(caught.value)
    assert str(caught.value).startswith("file.usda: ")


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


HEIR = 'def "A" (references = @./lib.usda@</A>) {}\nclass "_c" (references = </L0>) {}\n'
TENFOLD = "".join(
    f'def "L{i}" {{'
    + "".join(f'def "c{j}" (references = </L{i + 1}>) {{}}\n' for j in range(10))
    + "}\n"
    for i in range(12)
)
DEEP = opening.MAX_DEPTH + 1


@for_each(
    "text, most_s, message",
    [
        (f"{HEAD}{HEIR}{TENFOLD}", 20, "composes more than 1000 prims"),
        (f'{HEAD}{chain(999)}def "L999" {{}}', 0.3, "processor seconds to compose and more follow"),
        (
            f'{HEAD}{paired_arcs(16)}def "A16" {{}}\ndef "B16" {{}}\n',
            20,
            "too many arcs meet in one prim",
        ),
        (HEAD + 'def "a" {\n' * DEEP + "}\n" * DEEP, 20, "nested more than 150 deep"),
    ],
)
def test_what_arcs_multiply_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, most_s: float, message: str
) -> None:
    """10^12 prims by a class that its heir brings; more bombs are in `tests/hostile`."""
    monkeypatch.setattr(opening, "MAX_PRIMS", 1000)
    monkeypatch.setattr(opening, "MAX_COMPOSITION_S", most_s)
    (tmp_path / "lib.usda").write_text(f'{HEAD}class "_c" {{}}\ndef "A" (inherits = </_c>) {{}}')
    (tmp_path / "bomb.usda").write_text(text)
    with pytest.raises(TrilightError, match=message):
        prims_of(OpenedStage(tmp_path / "bomb.usda"))


def test_exactly_what_composition_makes_is_counted_and_one_prototype_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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

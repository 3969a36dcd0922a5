"""What arcs and instances multiply is counted as it is composed, and left when it is too much."""

from pathlib import Path

import pytest
from pxr import Usd, UsdGeom

from pipeline.usd import composition, placed
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.pipeline.usd.test_stage import HEAD, prims_of


def chain(length: int) -> str:
    arcs = "".join(f'def "L{i}" (references = </L{i + 1}>) {{}}\n' for i in range(length))
    return f'{HEAD}{arcs}def "L{length}" {{}}'


def doubled(levels: int) -> str:
    arcs = "".join(
        f'def "{name}{i}" (references = [</A{i + 1}>, </B{i + 1}>]) {{}}\n'
        for i in range(levels)
        for name in "AB"
    )
    return f'{HEAD}{arcs}def "A{levels}" {{}}\ndef "B{levels}" {{}}\n'


HEIR = 'def "A" (references = @./lib.usda@</A>) {}\nclass "_c" (references = </L0>) {}\n'
TENFOLD = "".join(
    f'def "L{i}" {{'
    + "".join(f'def "c{j}" (references = </L{i + 1}>) {{}}\n' for j in range(10))
    + "}\n"
    for i in range(12)
)
DEEP = composition.MAX_DEPTH + 1


@for_each(
    "text, most_s, message",
    [
        (f"{HEAD}{HEIR}{TENFOLD}", 20, "composes more than 1000 prims"),
        (chain(999), 0.3, "processor seconds to compose and more follow"),
        (doubled(16), 20, "too many arcs meet in one prim"),
        (HEAD + 'def "a" {\n' * DEEP + "}\n" * DEEP, 20, "nested more than 150 deep"),
    ],
)
def test_what_arcs_multiply_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, most_s: float, message: str
) -> None:
    """10^12 prims by a class that its heir brings; more bombs are in `tests/hostile`."""
    monkeypatch.setattr(composition, "MAX_PRIMS", 1000)
    monkeypatch.setattr(composition, "MAX_COMPOSITION_S", most_s)
    (tmp_path / "lib.usda").write_text(f'{HEAD}class "_c" {{}}\ndef "A" (inherits = </_c>) {{}}')
    (tmp_path / "bomb.usda").write_text(text)
    with pytest.raises(TrilightError, match=message):
        prims_of(tmp_path / "bomb.usda")


def test_exactly_what_composition_makes_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "b.usda").write_text(
        f'{HEAD}def "P" {{\ndef "a" {{}}\ndef "b" {{}}\n}}\n'
        'def "Q" (references = </P>) {\ndef "c" (references = </P>) {}\n}\n'
        'def "R" (inherits = </Q>) {\nover "c" {\ndef "d" {}\n}\n}\n'
    )
    monkeypatch.setattr(composition, "MAX_PRIMS", 17)  # with the root of all
    assert len(prims_of(tmp_path / "b.usda")) == 16
    monkeypatch.setattr(composition, "MAX_PRIMS", 16)
    with pytest.raises(TrilightError, match="more than 16 prims"):
        prims_of(tmp_path / "b.usda")


def test_instances_of_one_prototype_count_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = "".join(f'def "c{i}" {{}}\n' for i in range(50))
    heirs = "".join(
        f'def "I{i}" (instanceable = true\nreferences = </P>) {{}}\n' for i in range(50)
    )
    (tmp_path / "i.usda").write_text(f'{HEAD}def "P" {{\n{inner}}}\n{heirs}')
    monkeypatch.setattr(composition, "MAX_PRIMS", 1 + 51 + 50 + 50)
    prims_of(tmp_path / "i.usda")


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


def test_instances_stand_in_their_order() -> None:
    lost: list[str] = []
    found = placed.placed_prims(stage_of("/many/mesh", 3), Usd.TimeCode.Default(), lost)
    assert [each.to_world[0, 3] for each in found] == [0, 1, 2]


def test_too_many_instances_are_refused_before_their_places_are_computed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(placed, "MAX_PLACED", 4)
    with pytest.raises(TrilightError, match="/many: 5 instances; expected at most 4"):
        placed.placed_prims(stage_of("/many/mesh", 5), Usd.TimeCode.Default(), [])


def test_an_instancer_within_itself_is_refused() -> None:
    """Every level would hold the places of its instances."""
    with pytest.raises(TrilightError, match="/many: nested more than 150 deep"):
        placed.placed_prims(stage_of("/many", 2), Usd.TimeCode.Default(), [])

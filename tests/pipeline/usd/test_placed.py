"""Instances are bounded before they are placed: by number, and by how deep they nest."""

import pytest
from pxr import Usd, UsdGeom

from pipeline.usd import placed
from storage.errors import TrilightError


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

"""The families of renderformer-v1 are the published ones, in both background policies."""

import itertools

import numpy as np
import pytest

from scene_templates.families import DEFAULT_FAMILIES, Family
from scene_templates.layout import ShellPart
from scene_templates.renderformer_v1 import Policy, stage_1_families, stage_2_families
from scene_templates.rooms import SIDES, PatchPlacement, patch, plane_of
from scene_templates.separate_sides import SeparateSides
from scene_templates.settings import SceneSettings
from scene_templates.templates import TEMPLATES
from tests.for_each import for_each
from tests.scene_templates.balls import one_drawn
from tests.scene_templates.published import DEFAULT, STAGE_1, STAGE_2, Row, side_row

POLICIES: tuple[Policy, ...] = ("original", "de-biased")

STAGES = {1: (stage_1_families, STAGE_1), 2: (stage_2_families, STAGE_2)}


def _as_rows(families: tuple[Family, ...]) -> tuple[Row, ...]:
    for family in families:
        assert family.template == family.name.split("-")[0]
    return tuple(
        (one.name, one.weight, one.num_objects, one.object_scale, one.smooth_share)
        for one in families
    )


@pytest.mark.parametrize("policy", POLICIES)
def test_families_are_the_published_ones(policy: Policy) -> None:
    first, second = stage_1_families(policy), stage_2_families(policy)
    assert _as_rows(first) == STAGE_1
    assert _as_rows(second) == STAGE_2
    assert (len(first), sum(family.weight for family in first)) == (21, 46)
    assert (len(second), sum(family.weight for family in second)) == (14, 42)


def test_our_families_are_the_stated_ones() -> None:
    assert _as_rows(DEFAULT_FAMILIES) == DEFAULT


@for_each(("policy", "stage"), itertools.product(POLICIES, STAGES))
def test_every_side_has_its_published_ranges(policy: Policy, stage: int) -> None:
    for family in STAGES[stage][0](policy):
        assert isinstance(family.shell, SeparateSides)
        for part in TEMPLATES[family.template].parts:
            side = getattr(family.shell, part)
            moves = (side.shift_x, side.shift_y, side.shift_z)
            found = (side.spin_deg, side.tilt_deg, side.scale, *moves)
            assert found == side_row(family.name, part, policy, stage), (family.name, part)
        assert family.shell.wall2_faces_out == (
            policy == "original" and ("open_box" in family.name or "patch" in family.name)
        )


def _shell(family: Family) -> tuple[ShellPart, ...]:
    return one_drawn(SceneSettings(families=(family,)), 0).layout.shell


@pytest.mark.parametrize("policy", POLICIES)
def test_only_the_original_box_turns_one_wall_away(policy: Policy) -> None:
    """The normal of each face, against the direction to the middle of the nominal room."""
    for family in (*stage_1_families(policy), *stage_2_families(policy)):
        if family.template != "open_box":
            continue
        for part in _shell(family):
            corners = part.positions[part.faces]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            inward = np.einsum("tk,k->t", normals, plane_of(part.positions).normal)
            turned_away = part.name == "wall2" and policy == "original"
            assert ((inward < 0) == turned_away).all()


@pytest.mark.parametrize("policy", POLICIES)
def test_patch_families_are_the_exact_unit_box(policy: Policy) -> None:
    still = PatchPlacement(
        rotation_deg=(0, 0, 0), reach=1.0, scale=(1, 1, 1), translation=(0, 0, 0)
    )
    seen = set()
    for family in (*stage_1_families(policy), *stage_2_families(policy)):
        if "patch" in family.name:
            for part in _shell(family):
                assert np.array_equal(part.positions, patch(SIDES[part.name], still))
                assert (np.abs(part.positions[:, SIDES[part.name].axis]) == 0.5).all()
                seen.add((family.template, part.name))
    assert len(seen) == 3 + 4 + 2  # parts of corner, box and wall

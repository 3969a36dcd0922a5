"""The families of RenderFormer V1, as far as they are known (reference: renderformer.md, A.1-A.3).

Known: names and weights of the 21 families of stage 1 and the 14 of stage 2, which backgrounds each
has and their ranges, object counts, and most object sizes. Not known, and chosen here:

- the sizes of objects in front of a single wall, and in the boxes of stage 2 with one object: those
  of the nearest family that is known;
- the counts of the stage-2 families with more objects before walls and in corners: up to five, as
  in the box;
- which objects the `special` families hold. They are published as six bundled primitives; the same
  six shapes in every split would let geometry cross the splits, so they draw from the pool as the
  others do, and keep their smooth share of 0.25;
- on which side the walls of the original policy stood: the repair turned some one-sided shifts
  (-0.25 to -0.15) into the +-0.25 that both policies have here;
- `thin` objects: published as a list of their own; here from the pool.

The two background policies are those of `SeparateSides`; both public stages use `de-biased`.
"""

from dataclasses import replace
from typing import Literal

from scene_templates.checks import Range
from scene_templates.families import Family
from scene_templates.rooms import SeparateSides, SideRanges

Policy = Literal["original", "de-biased"]

_SINGLE = (1, 1)
_MULTI = (2, 3)
_NONE = (0, 0)
_NEAR: Range = (-0.05, 0.05)
_FAR: Range = (-0.25, 0.25)
_RAISED: Range = (0.15, 0.25)
_FREE: Range = (-0.05, 0.25)
_EXACT: Range = (0.0, 0.0)
_STILL = SideRanges(
    spin_deg=0.0, tilt_deg=0.0, scale=(1.0, 1.0), shift_x=_EXACT, shift_y=_EXACT, shift_z=_EXACT
)
_UNTURNED = SeparateSides(
    floor=_STILL, wall0=_STILL, wall1=_STILL, wall2=_STILL, wall2_faces_out=False
)

_Row = tuple[str, int, tuple[int, int], Range]
"""Name, weight, numbers of objects, and their sizes."""

_STAGE_1: tuple[_Row, ...] = (
    ("corner-multi", 3, _MULTI, (0.8, 1.8)),
    ("corner-single", 3, _SINGLE, (1.6, 2.1)),
    ("corner-none", 1, _NONE, (1.6, 2.1)),
    ("corner-multi-patch", 1, _MULTI, (0.8, 1.8)),
    ("corner-single-patch", 1, _SINGLE, (1.6, 2.1)),
    ("corner-multi-special", 2, _MULTI, (0.8, 1.8)),
    ("corner-single-special", 2, _SINGLE, (1.6, 2.1)),
    ("open_box-multi", 3, _MULTI, (0.8, 1.8)),
    ("open_box-single", 3, _SINGLE, (1.8, 2.0)),
    ("open_box-multi-patch", 1, _MULTI, (0.8, 1.8)),
    ("open_box-single-patch", 1, _SINGLE, (1.8, 2.0)),
    ("open_box-none", 1, _NONE, (1.8, 2.0)),
    ("plane-multi", 3, _MULTI, (0.8, 1.8)),
    ("plane-single", 3, _SINGLE, (1.2, 2.2)),
    ("plane-none", 1, _NONE, (1.2, 2.2)),
    ("wall-multi", 3, _MULTI, (0.8, 1.8)),
    ("wall-single", 3, _SINGLE, (1.6, 2.1)),
    ("wall-none", 1, _NONE, (1.6, 2.1)),
    ("wall-multi-patch", 1, _MULTI, (0.8, 1.8)),
    ("wall-single-patch", 1, _SINGLE, (1.6, 2.1)),
    ("plane-single-thin", 8, _SINGLE, (1.4, 1.6)),
)

_STAGE_2: tuple[_Row, ...] = (
    ("corner-multi", 3, _MULTI, (0.8, 1.8)),
    ("corner-single", 3, _SINGLE, (1.6, 2.1)),
    ("open_box-multi", 3, _MULTI, (1.0, 1.8)),
    ("open_box-single", 3, _SINGLE, (1.8, 2.0)),
    ("open_box-multi-patch", 2, _MULTI, (1.0, 1.8)),
    ("open_box-single-patch", 2, _SINGLE, (1.8, 2.0)),
    ("plane-multi", 4, _MULTI, (0.8, 1.8)),
    ("plane-single", 4, _SINGLE, (1.8, 2.2)),
    ("wall-multi", 3, _MULTI, (0.8, 1.8)),
    ("wall-single", 3, _SINGLE, (1.6, 2.1)),
    ("corner-more", 3, (0, 5), (1.4, 1.6)),
    ("open_box-more", 3, (0, 5), (1.4, 1.6)),
    ("plane-more", 3, (0, 6), (1.4, 1.6)),
    ("wall-more", 3, (0, 5), (1.4, 1.6)),
)


def stage_1_families(policy: Policy) -> tuple[Family, ...]:
    """Return the 21 families of the 256-pixel stage (weights add up to 46)."""
    return tuple(_family(policy, row, floor_z=_RAISED) for row in _STAGE_1)


def stage_2_families(policy: Policy) -> tuple[Family, ...]:
    """Return the 14 families of the 512-pixel stage (weights add up to 42)."""
    # The de-bias lowers the raised floor of the families with more objects.
    more_z = _FREE if policy == "de-biased" else _RAISED
    return tuple(
        _family(policy, row, floor_z=more_z if row[0].endswith("more") else _FREE)
        for row in _STAGE_2
    )


def _family(policy: Policy, row: _Row, *, floor_z: Range) -> Family:
    name, weight, num_objects, object_scale = row
    template, _, kind = name.partition("-")
    return Family(
        name=name,
        template=template,
        weight=float(weight),
        shell=_shell("patch" if kind.endswith("patch") else template, policy, floor_z),
        num_objects=num_objects,
        object_scale=object_scale,
        smooth_share=0.25 if kind.endswith("special") else 0.5,
    )


def _shell(kind: str, policy: Policy, floor_z: Range) -> SeparateSides:
    """Return the ranges of a template's sides, or of the exact Cornell-like box, `patch`."""
    original = policy == "original"
    side = SideRanges(
        spin_deg=10.0 if original else 180.0,
        tilt_deg=10.0,
        scale=(0.9, 1.35),
        shift_x=_NEAR,
        shift_y=_NEAR,
        shift_z=_NEAR,
    )
    if kind == "patch":  # a spin of exactly 0 stays 0 in both policies
        return replace(_UNTURNED, wall2_faces_out=original)
    if kind == "open_box":
        turned = (0.5, 0.5) if original else (180.0, 3.0)
        side = replace(side, spin_deg=turned[0], tilt_deg=turned[1], scale=(1.0, 1.35))
        return SeparateSides(
            floor=side, wall0=side, wall1=side, wall2=side, wall2_faces_out=original
        )
    if kind == "corner":
        wall0 = replace(side, shift_y=_FAR)
        return replace(_UNTURNED, floor=side, wall0=wall0, wall1=replace(side, shift_x=_FAR))
    wall1 = replace(side, shift_y=_FAR) if kind == "wall" else _STILL
    return replace(_UNTURNED, floor=replace(side, shift_z=floor_z), wall1=wall1)

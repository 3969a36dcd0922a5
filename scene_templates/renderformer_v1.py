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
    spin_deg=0.0,
    tilt_deg=0.0,
    scale=(1.0, 1.0),
    shift_x=_EXACT,
    shift_y=_EXACT,
    shift_z=_EXACT,
)
_UNTURNED = SeparateSides(
    floor=_STILL, wall0=_STILL, wall1=_STILL, wall2=_STILL, wall2_faces_out=False
)


def stage_1_families(policy: Policy) -> tuple[Family, ...]:
    """Return the 21 families of the 256-pixel stage (weights add up to 46)."""
    plane = _open_shell(policy, floor_z=_RAISED, wall=False)
    wall = _open_shell(policy, floor_z=_RAISED, wall=True)
    corner = _corner_shell(policy)
    box = _box_shell(policy)
    patch = _exact_shell(policy)
    return (
        _family("corner-multi", 3, corner, _MULTI, (0.8, 1.8)),
        _family("corner-single", 3, corner, _SINGLE, (1.6, 2.1)),
        _family("corner-none", 1, corner, _NONE, (1.6, 2.1)),
        _family("corner-multi-patch", 1, patch, _MULTI, (0.8, 1.8)),
        _family("corner-single-patch", 1, patch, _SINGLE, (1.6, 2.1)),
        _family("corner-multi-special", 2, corner, _MULTI, (0.8, 1.8), smooth_share=0.25),
        _family("corner-single-special", 2, corner, _SINGLE, (1.6, 2.1), smooth_share=0.25),
        _family("open_box-multi", 3, box, _MULTI, (0.8, 1.8)),
        _family("open_box-single", 3, box, _SINGLE, (1.8, 2.0)),
        _family("open_box-multi-patch", 1, patch, _MULTI, (0.8, 1.8)),
        _family("open_box-single-patch", 1, patch, _SINGLE, (1.8, 2.0)),
        _family("open_box-none", 1, box, _NONE, (1.8, 2.0)),
        _family("plane-multi", 3, plane, _MULTI, (0.8, 1.8)),
        _family("plane-single", 3, plane, _SINGLE, (1.2, 2.2)),
        _family("plane-none", 1, plane, _NONE, (1.2, 2.2)),
        _family("wall-multi", 3, wall, _MULTI, (0.8, 1.8)),
        _family("wall-single", 3, wall, _SINGLE, (1.6, 2.1)),
        _family("wall-none", 1, wall, _NONE, (1.6, 2.1)),
        _family("wall-multi-patch", 1, patch, _MULTI, (0.8, 1.8)),
        _family("wall-single-patch", 1, patch, _SINGLE, (1.6, 2.1)),
        _family("plane-single-thin", 8, plane, _SINGLE, (1.4, 1.6)),
    )


def stage_2_families(policy: Policy) -> tuple[Family, ...]:
    """Return the 14 families of the 512-pixel stage (weights add up to 42)."""
    plane = _open_shell(policy, floor_z=_FREE, wall=False)
    wall = _open_shell(policy, floor_z=_FREE, wall=True)
    # The de-bias lowers the raised floor of the families with more objects.
    more_z = _FREE if policy == "de-biased" else _RAISED
    more_plane = _open_shell(policy, floor_z=more_z, wall=False)
    more_wall = _open_shell(policy, floor_z=more_z, wall=True)
    corner = _corner_shell(policy)
    box = _box_shell(policy)
    patch = _exact_shell(policy)
    return (
        _family("corner-multi", 3, corner, _MULTI, (0.8, 1.8)),
        _family("corner-single", 3, corner, _SINGLE, (1.6, 2.1)),
        _family("open_box-multi", 3, box, _MULTI, (1.0, 1.8)),
        _family("open_box-single", 3, box, _SINGLE, (1.8, 2.0)),
        _family("open_box-multi-patch", 2, patch, _MULTI, (1.0, 1.8)),
        _family("open_box-single-patch", 2, patch, _SINGLE, (1.8, 2.0)),
        _family("plane-multi", 4, plane, _MULTI, (0.8, 1.8)),
        _family("plane-single", 4, plane, _SINGLE, (1.8, 2.2)),
        _family("wall-multi", 3, wall, _MULTI, (0.8, 1.8)),
        _family("wall-single", 3, wall, _SINGLE, (1.6, 2.1)),
        _family("corner-more", 3, corner, (0, 5), (1.4, 1.6)),
        _family("open_box-more", 3, box, (0, 5), (1.4, 1.6)),
        _family("plane-more", 3, more_plane, (0, 6), (1.4, 1.6)),
        _family("wall-more", 3, more_wall, (0, 5), (1.4, 1.6)),
    )


def _family(
    name: str,
    weight: float,
    shell: SeparateSides,
    num_objects: tuple[int, int],
    object_scale: Range,
    *,
    smooth_share: float = 0.5,
) -> Family:
    return Family(
        name=name,
        template=name.split("-")[0],
        weight=float(weight),
        shell=shell,
        num_objects=num_objects,
        object_scale=object_scale,
        smooth_share=smooth_share,
    )


def _open_shell(policy: Policy, *, floor_z: Range, wall: bool) -> SeparateSides:
    wall1 = _side(policy, y=_FAR) if wall else _STILL
    return replace(_UNTURNED, floor=_side(policy, z=floor_z), wall1=wall1)


def _corner_shell(policy: Policy) -> SeparateSides:
    floor = _side(policy)
    return replace(
        _UNTURNED,
        floor=floor,
        wall0=replace(floor, shift_y=_FAR),
        wall1=replace(floor, shift_x=_FAR),
    )


def _box_shell(policy: Policy) -> SeparateSides:
    original = policy == "original"
    side = replace(
        _side(policy),
        spin_deg=0.5 if original else 180.0,
        tilt_deg=0.5 if original else 3.0,
        scale=(1.0, 1.35),
    )
    return SeparateSides(floor=side, wall0=side, wall1=side, wall2=side, wall2_faces_out=original)


def _exact_shell(policy: Policy) -> SeparateSides:
    """Return the unturned Cornell-like box; a spin of exactly 0 stays 0 in both policies."""
    return replace(_UNTURNED, wall2_faces_out=policy == "original")


def _side(policy: Policy, *, y: Range = _NEAR, z: Range = _NEAR) -> SideRanges:
    return SideRanges(
        spin_deg=180.0 if policy == "de-biased" else 10.0,
        tilt_deg=10.0,
        scale=(0.9, 1.35),
        shift_x=_NEAR,
        shift_y=y,
        shift_z=z,
    )

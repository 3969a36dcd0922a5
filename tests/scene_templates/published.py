"""The published recipes once more, written down from the reference and not from our settings.

Rows that the recipes leave open, and that are ours, are marked.
"""

from scene_templates.checks import Range

Row = tuple[str, float, tuple[int, int], Range, float]
"""Name, weight, fewest and most objects, diameter of their spheres before halving, smooth share."""

SINGLE, MULTI, NONE = (1, 1), (2, 3), (0, 0)

STAGE_1: tuple[Row, ...] = (
    ("corner-multi", 3, MULTI, (0.8, 1.8), 0.5),
    ("corner-single", 3, SINGLE, (1.6, 2.1), 0.5),
    ("corner-none", 1, NONE, (1.6, 2.1), 0.5),
    ("corner-multi-patch", 1, MULTI, (0.8, 1.8), 0.5),
    ("corner-single-patch", 1, SINGLE, (1.6, 2.1), 0.5),
    ("corner-multi-special", 2, MULTI, (0.8, 1.8), 0.25),
    ("corner-single-special", 2, SINGLE, (1.6, 2.1), 0.25),
    ("open_box-multi", 3, MULTI, (0.8, 1.8), 0.5),
    ("open_box-single", 3, SINGLE, (1.8, 2.0), 0.5),
    ("open_box-multi-patch", 1, MULTI, (0.8, 1.8), 0.5),
    ("open_box-single-patch", 1, SINGLE, (1.8, 2.0), 0.5),
    ("open_box-none", 1, NONE, (1.8, 2.0), 0.5),
    ("plane-multi", 3, MULTI, (0.8, 1.8), 0.5),
    ("plane-single", 3, SINGLE, (1.2, 2.2), 0.5),
    ("plane-none", 1, NONE, (1.2, 2.2), 0.5),
    ("wall-multi", 3, MULTI, (0.8, 1.8), 0.5),
    ("wall-single", 3, SINGLE, (1.6, 2.1), 0.5),  # size ours
    ("wall-none", 1, NONE, (1.6, 2.1), 0.5),
    ("wall-multi-patch", 1, MULTI, (0.8, 1.8), 0.5),
    ("wall-single-patch", 1, SINGLE, (1.6, 2.1), 0.5),  # size ours
    ("plane-single-thin", 8, SINGLE, (1.4, 1.6), 0.5),
)
"""The 21 templates of the 256-pixel stage; weights add up to 46."""

STAGE_2: tuple[Row, ...] = (
    ("corner-multi", 3, MULTI, (0.8, 1.8), 0.5),
    ("corner-single", 3, SINGLE, (1.6, 2.1), 0.5),
    ("open_box-multi", 3, MULTI, (1.0, 1.8), 0.5),
    ("open_box-single", 3, SINGLE, (1.8, 2.0), 0.5),  # size ours
    ("open_box-multi-patch", 2, MULTI, (1.0, 1.8), 0.5),
    ("open_box-single-patch", 2, SINGLE, (1.8, 2.0), 0.5),  # size ours
    ("plane-multi", 4, MULTI, (0.8, 1.8), 0.5),
    ("plane-single", 4, SINGLE, (1.8, 2.2), 0.5),
    ("wall-multi", 3, MULTI, (0.8, 1.8), 0.5),
    ("wall-single", 3, SINGLE, (1.6, 2.1), 0.5),  # size ours
    ("corner-more", 3, (0, 5), (1.4, 1.6), 0.5),  # count ours
    ("open_box-more", 3, (0, 5), (1.4, 1.6), 0.5),
    ("plane-more", 3, (0, 6), (1.4, 1.6), 0.5),
    ("wall-more", 3, (0, 5), (1.4, 1.6), 0.5),  # count ours
)
"""The 14 templates of the 512-pixel stage; weights add up to 42."""

DEFAULT: tuple[Row, ...] = tuple(
    row
    for name in ("plane", "wall", "corner", "open_box")
    for row in (
        (f"{name}-single", 1.0, SINGLE, (1.2, 2.2), 0.5),
        (f"{name}-multi", 2.0, MULTI, (0.8, 1.8), 0.5),
    )
)
"""Our own families: each layout and each number of objects from 1 to 3 equally often."""

NEAR, FAR, RAISED, FREE = (-0.05, 0.05), (-0.25, 0.25), (0.15, 0.25), (-0.05, 0.25)

SideRow = tuple[float, float, Range, Range, Range, Range]
"""Most spin and tilt in degrees, scale, and shift along x, y and z before halving."""


def side_row(family: str, part: str, policy: str, stage: int) -> SideRow:
    """Return from what a floor or wall of a family is drawn."""
    template, *kinds = family.split("-")
    repaired = policy == "de-biased"
    if "patch" in kinds:
        return (0.0, 0.0, (1.0, 1.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    if template == "open_box":
        return (180.0, 3.0, (1.0, 1.35), NEAR, NEAR, NEAR) if repaired else _hardly_turned()
    spin = 180.0 if repaired else 10.0
    x, y, z = NEAR, NEAR, NEAR
    if part == "floor" and template in ("plane", "wall"):
        # Stage 1 raises its floors in both policies. In stage 2 all are free, but for those of the
        # families with more objects before the repair.
        z = RAISED if stage == 1 or ("more" in kinds and not repaired) else FREE
    if (template, part) in (("corner", "wall0"), ("wall", "wall1")):
        y = FAR
    if (template, part) == ("corner", "wall1"):
        x = FAR
    return (spin, 10.0, (0.9, 1.35), x, y, z)


def _hardly_turned() -> SideRow:
    return (0.5, 0.5, (1.0, 1.35), NEAR, NEAR, NEAR)

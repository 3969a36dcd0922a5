"""Where things are follows its stated distribution: rooms, resting objects, lights, cameras.

Each is drawn by itself, since in a whole scene one hides the other. The line between chance and a
defect is that of `statistics`.
"""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from scene_templates.layout import CameraPose
from scene_templates.renderformer_v1 import Policy, stage_1_families, stage_2_families
from scene_templates.rooms import SIDES, PatchPlacement, SharedRoom, plane_of
from scene_templates.sample_camera import CameraSettings, Sector, sample_camera
from scene_templates.sample_lights import LightSettings, sample_lights
from scene_templates.templates import TEMPLATES
from tests.for_each import for_each
from tests.scene_templates.balls import drawn, template_settings
from tests.scene_templates.statistics import (
    Table,
    alike,
    choices,
    implausible,
    require_plausible,
    share,
    uniform,
)

COUNT = 800


def _placements(
    shell: SharedRoom, template: str, count: int = COUNT
) -> list[tuple[PatchPlacement, ...]]:
    rng = np.random.default_rng(0)
    rooms = (shell.sample_room(rng, TEMPLATES[template].parts) for _ in range(count))
    return [tuple(room.patches.values()) for room in rooms]


def _shared_room_table(shell: SharedRoom) -> Table:
    rooms = _placements(shell, "corner")
    floors = [patches[0] for patches in rooms]
    scale, move = (np.array([getattr(f, n) for f in floors]) for n in ("scale", "translation"))
    square = np.array([one.reach == 1 for one in floors])
    table = {"square": share(square, 0.5)}
    for axis, name in enumerate("xyz"):
        table[f"scale {name}"] = uniform(scale[:, axis], 1.0, 1.35)
        table[f"move {name}"] = uniform(
            move[:, axis], *((-0.05, 0.25) if axis == 2 else (-0.05, 0.05))
        )
    for row, part in enumerate(TEMPLATES["corner"].parts):
        turns = np.array([patches[row].rotation_deg for patches in rooms])
        axis = SIDES[part].axis
        table[f"{part} spin square"] = choices(
            turns[square, axis].tolist(), dict.fromkeys((0.0, 90.0, 180.0, 270.0), 1.0)
        )
        table[f"{part} spin"] = uniform(turns[~square, axis], -180, 180)
        for other in {0, 1, 2} - {axis}:
            table[f"{part} tilt {other}"] = uniform(turns[~square, other], -3, 3)
            table[f"{part} tilt {other} square"] = uniform(turns[square, other], 0, 0)
    return table


def test_shared_rooms_are_drawn_as_stated() -> None:
    require_plausible(_shared_room_table(SharedRoom()))
    for patches in _placements(SharedRoom(), "open_box", 50):
        assert len({(one.scale, one.translation) for one in patches}) == 1


def test_a_wrong_room_is_noticed() -> None:
    wrong = SharedRoom(
        square_share=0.35, scale=(1.0, 1.3), shift=0.03, raise_z=(0.0, 0.2), tilt_deg=1.5
    )
    rows = {"square", "floor tilt 0", "wall0 tilt 2", "wall1 tilt 1"}
    rows |= {f"{quantity} {axis}" for quantity in ("scale", "move") for axis in "xyz"}
    assert rows <= set(implausible(_shared_room_table(wrong)))


def _sides_table(stage: int, policy: Policy) -> Table:
    """p-values of every quantity of every side, over the families that share its ranges."""
    found: dict[tuple[str, ...], list[float]] = {}
    stated: dict[tuple[str, ...], tuple[float, float]] = {}
    rng = np.random.default_rng(stage)
    for family in (stage_1_families if stage == 1 else stage_2_families)(policy):
        parts = TEMPLATES[family.template].parts
        for _ in range(100):
            patches = family.shell.sample_room(rng, parts).patches
            assert tuple(patches) == parts
            for part, at in patches.items():
                assert at.reach == 1
                axis = SIDES[part].axis
                side = getattr(family.shell, part)
                tilt, moves = side.tilt_deg, (side.shift_x, side.shift_y, side.shift_z)
                rows = [("spin", at.rotation_deg[axis], (-side.spin_deg, side.spin_deg))]
                others = sorted({0, 1, 2} - {axis})
                rows += [(f"tilt {k}", at.rotation_deg[k], (-tilt, tilt)) for k in others]
                for k in range(3):
                    rows.append((f"scale {k}", at.scale[k], side.scale))
                    rows.append((f"move {k}", at.translation[k], moves[k]))
                for quantity, value, bounds in rows:
                    key = (family.template, part, quantity, str(bounds))
                    found.setdefault(key, []).append(value)
                    stated[key] = bounds
    return {" ".join(key): uniform(values, *stated[key]) for key, values in found.items()}


@for_each(("policy", "stage"), itertools.product(["original", "de-biased"], [1, 2]))
def test_separate_sides_are_drawn_as_published(policy: Policy, stage: int) -> None:
    require_plausible(_sides_table(stage, policy))


ROOM = {
    "families.num_objects": [1, 1],
    "families.shell.square_share": 1.0,
    "families.shell.scale": [1.2, 1.2],
    "families.shell.shift": 0.0,
    "families.shell.raise_z": [0.0, 0.0],
}
"""One object over a floor of side 0.6 about the origin, which is at z = -0.6."""


def test_a_single_object_is_placed_evenly_and_rests_half_the_time() -> None:
    """Within what an object's own points leave it, its place is even: nothing else decides."""
    scenes = drawn(template_settings("plane", ROOM), COUNT)
    radius = np.array([one.layout.objects[0].pose.radius for one in scenes])
    centre = np.stack([one.layout.objects[0].pose.centre for one in scenes])
    lowest = np.array([one.points(0)[:, 2].min() for one in scenes])
    floors = [plane_of(one.layout.shell[0].positions) for one in scenes]
    above = [floor.height(one.points(0)).min() for floor, one in zip(floors, scenes, strict=True)]
    rests = np.array(above) < 1e-9  # a floating one comes so near once in 1e8 times
    reach = 0.5 - radius / 2  # beside the open sides by half its radius at most
    least = -0.6 + (centre[:, 2] - lowest)
    height = ((centre[:, 2] - least) / (reach - least))[~rests]
    scale = template_settings("plane").families[0].object_scale
    table = {
        "rests": share(rests, 0.5),
        "x": uniform(centre[:, 0] / reach, -1, 1),
        "y": uniform(centre[:, 1] / reach, -1, 1),
        "height": uniform(height, 0, 1),
        "size": uniform(4 * radius, *scale),
        "size of resting": uniform(4 * radius[rests], *scale),
    }
    require_plausible(table)


def _off_deg(directions: NDArray[np.float64], sector: Sector) -> NDArray[np.float64]:
    """Angle of the azimuth of each direction from the middle of a sector."""
    azimuth_deg = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
    return np.asarray((azimuth_deg - sector.azimuth_deg + 180) % 360 - 180)


def _sector_table(directions: NDArray[np.float64], sector: Sector) -> Table:
    low, high = (math.sin(math.radians(angle)) for angle in sector.elevation_deg)
    return {
        "elevation": uniform(directions[:, 2], low, high),
        "azimuth": uniform(
            _off_deg(directions, sector), -sector.half_width_deg, sector.half_width_deg
        ),
    }


def _light_centres(sector: Sector, **changes: object) -> NDArray[np.float64]:
    settings = LightSettings(**changes)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    drawn_ones = [sample_lights(rng, settings, sector, 1, [])[0] for _ in range(COUNT)]
    return np.stack([one.triangle.mean(axis=0) for one in drawn_ones])


@for_each("name", TEMPLATES)
def test_lights_hang_evenly_in_their_sector(name: str) -> None:
    sector = TEMPLATES[name].lights
    centres = _light_centres(sector, target_jitter=0.0)
    distance = np.linalg.norm(centres, axis=1)
    table = {"distance": uniform(distance, 2.1, 2.7)}
    table |= _sector_table(centres / distance[:, None], sector)
    # As near as can be to the point that they hang around: a millimetre of 400 is not seen in it.
    for axis, around in enumerate(_light_centres(sector, distance=(1e-3, 1e-3)).T):
        table[f"target {axis}"] = uniform(around, -0.2, 0.2)
    require_plausible(table)


def _cameras(sector: Sector, **changes: object) -> list[CameraPose]:
    settings = CameraSettings(**changes)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    return [sample_camera(rng, settings, sector) for _ in range(COUNT)]


def _camera_table(sector: Sector, **changes: object) -> Table:
    poses = _cameras(sector, **changes)
    backward = np.stack([pose.c2w[:3, 2] for pose in poses])
    roll = [_roll(pose.c2w[:3, 1], pose.c2w[:3, 2]) for pose in poses]
    still = _cameras(sector, **{**changes, "target_jitter": 0.0})
    near = _cameras(sector, **{**changes, "distance": (1e-3, 1e-3)})
    table = {
        "fov": uniform([pose.fov_deg for pose in poses], 30, 60),
        "distance": uniform([np.linalg.norm(pose.c2w[:3, 3]) for pose in still], 1.5, 2.0),
        "roll": alike(roll, _roll_twin(sector)),
        **_sector_table(backward, sector),
    }
    for axis in range(3):
        targets = [pose.c2w[axis, 3] - 1e-3 * pose.c2w[axis, 2] for pose in near]
        table[f"target {axis}"] = uniform(targets, -0.2, 0.2)
    return table


def _roll(up: NDArray[np.float64], backward: NDArray[np.float64]) -> float:
    """Angle by which a picture's up leans from the one that +Z gives."""
    right = np.array([-backward[1], backward[0], 0.0])
    return math.atan2(float(up @ right), float(up @ np.cross(backward, right)))


def _roll_twin(sector: Sector) -> list[float]:
    rng = np.random.default_rng(1)
    return [
        _roll(np.array([0, 0, 1]) + rng.uniform(-0.1, 0.1, size=3), sector.sample_direction(rng))
        for _ in range(2 * COUNT)
    ]


@for_each("name", TEMPLATES)
def test_cameras_are_drawn_as_stated(name: str) -> None:
    require_plausible(_camera_table(TEMPLATES[name].cameras))


def test_wrong_cameras_are_noticed() -> None:
    wrong = {"fov_deg": (30.0, 54.0), "distance": (1.5, 1.85), "up_jitter": 0.2}
    table = _camera_table(TEMPLATES["wall"].cameras, **wrong, target_jitter=0.13)
    targets = {f"target {axis}" for axis in range(3)}
    assert set(implausible(table)) == {"fov", "distance", "roll", *targets}

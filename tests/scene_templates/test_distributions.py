"""Every quantity that is drawn is distributed as stated, for our settings and published ones.

2000 layouts per setting with balls for objects. See `statistics` for the line that is drawn. The
stated numbers are written here once more, from what the default settings promise, and not read from
the settings that are under test; those of the published families are pinned (`published`).
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from pipeline.presets.registry import preset_settings
from scene_templates.layout import Emitter, SurfaceLook
from tests.scene_templates.balls import MANY, Drawn, drawn
from tests.scene_templates.published import DEFAULT, STAGE_1, STAGE_2, Row
from tests.scene_templates.statistics import (
    Table,
    alike,
    by_cdf,
    choices,
    require_plausible,
    share,
    uniform,
)

ROUGH_LOW, ROUGH_HIGH, ROUGH_BIAS = 0.06, 1.055, 0.05
"""exp(U(ln 0.06, ln 1.055)) - 0.05, clipped to at most 1."""


@dataclass(frozen=True, kw_only=True)
class Stated:
    """What the two kinds of settings say of a scene."""

    rows: tuple[Row, ...]
    """The families."""
    published: bool
    """Whether all objects may meet and none has colours by triangle, rotations are three Euler
    angles, and sizes and places free of what fits."""

    def row_of(self, one: Drawn) -> Row:
        """Return the family of a scene."""
        return next(row for row in self.rows if row[0] == one.plan.family.name)


def plan_table(scenes: Sequence[Drawn], stated: Stated) -> Table:
    """Families, counts and overlaps."""
    families = [one.plan.family.name for one in scenes]
    table = {
        "families": choices(families, {name: weight for name, weight, *_ in stated.rows}),
        "light counts": choices(
            [one.plan.num_lights for one in scenes], dict.fromkeys(range(1, 9), 1.0)
        ),
        "overlaps": share([one.plan.overlaps for one in scenes], 1.0 if stated.published else 0.1),
    }
    for low, high in sorted({row[2] for row in stated.rows}):
        found = [len(d.layout.objects) for d in scenes if stated.row_of(d)[2] == (low, high)]
        odds_of_counts = dict.fromkeys(range(low, high + 1), 1.0)
        table[f"object counts {low} to {high}"] = choices(found, odds_of_counts)
    return table


def rotation_table(rotations: Iterable[NDArray[np.float64]], *, euler: bool) -> Table:
    """Rotations [3, 3] uniform on SO(3), or of three even Euler angles about X, then Y, then Z."""
    turned = np.stack(list(rotations))
    if euler:
        # The lower row is (-sin y, cos y sin x, cos y cos x), and the left column alike.
        return {
            "euler y": by_cdf(-turned[:, 2, 0], stats.arcsine(-1, 2).cdf),
            "euler x": uniform(np.arctan2(turned[:, 2, 1], turned[:, 2, 2]), -math.pi, math.pi),
            "euler z": uniform(np.arctan2(turned[:, 1, 0], turned[:, 0, 0]), -math.pi, math.pi),
        }
    trace = np.trace(turned, axis1=1, axis2=2)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    axis = turned[:, [2, 0, 1], [1, 2, 0]] - turned[:, [1, 2, 0], [2, 0, 1]]
    table = {
        # Haar measure: density (1 - cos a) / pi of the angle, and an axis even on the sphere.
        "turning angle": by_cdf(angle, lambda a: (a - np.sin(a)) / math.pi),
        "axis z": uniform(axis[:, 2] / np.linalg.norm(axis, axis=1), -1, 1),
        "axis azimuth": uniform(np.arctan2(axis[:, 1], axis[:, 0]), -math.pi, math.pi),
    }
    for row in range(3):
        table[f"entry {row} {row}"] = uniform(turned[:, row, row], -1, 1)
    return table


def surface_table(
    surfaces: Sequence[SurfaceLook], *, smooth_share: float, by_triangle: float
) -> Table:
    """Everything that a material is drawn from."""
    sums = np.array([one.diffuse_scale + one.specular_rgb[0] for one in surfaces])
    specular = np.array([one.specular_rgb for one in surfaces])
    diffuse = np.array([one.diffuse_rgb for one in surfaces])
    scale = np.array([one.diffuse_scale for one in surfaces])
    rough = np.array([one.roughness for one in surfaces])
    smooth = [one for one in surfaces if one.smooth]
    low, high = math.log(ROUGH_LOW), math.log(ROUGH_HIGH)
    clipped = (high - math.log(1 + ROUGH_BIAS)) / (high - low)
    table = {
        "albedo sum": uniform(sums, 0.9, 1.0),
        "specular ratio": uniform(specular[:, 0] / sums, 0, 1),
        "specular is grey": float((specular == specular[:, :1]).all()),
        "roughness of 1": share(rough == 1, clipped),
        "roughness": uniform(np.log(rough[rough < 1] + ROUGH_BIAS), low, math.log(1 + ROUGH_BIAS)),
        "smooth": share([one.smooth for one in surfaces], smooth_share),
        "coloured": share([one.colours != "one" for one in smooth], 0.5),
        "flat is one colour": float(all(o.colours == "one" for o in surfaces if not o.smooth)),
    }
    for channel, name in enumerate(("red", "green", "blue")):
        table[name] = uniform(diffuse[:, channel] / scale, 0, 1)
    many = [one.colours == "triangles" for one in smooth if one.colours != "one"]
    table["by triangle"] = share(many, by_triangle)
    return table


def emitter_table(emitters: Sequence[Emitter], counts: Sequence[int], *, euler: bool) -> Table:
    """Radiance, size and turn of emitters in scenes of so many."""
    radiance = np.array([one.radiance_rgb for one in emitters])
    normals, scales = _unscaled(np.stack([one.triangle for one in emitters]))
    table = {
        "radiance": uniform(radiance[:, 0] * np.array(counts), 2500, 5000),
        "white": float((radiance == radiance[:, :1]).all()),
    }
    for axis, name in enumerate("xyz"):
        table[f"scale {name}"] = uniform(scales[:, axis], 2.0, 2.5)
        if euler:
            table[f"normal {name}"] = alike(normals[:, axis], np.abs(_euler_normals()[:, axis]))
        else:
            table[f"normal {name}"] = uniform(normals[:, axis], 0, 1)
    return table


def _unscaled(
    triangles: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return |normal| [N, 3] before scaling and scale [N, 3] of triangles that were equilateral.

    With the corners t of such a triangle as rows around its middle, t' t = c (I - m m') for its
    unit normal m; scaled per axis by s, the entries are c s_k s_l (1 or 0 - m_k m_l). Three
    correlations give the squares of m / sqrt(1 - m^2), and then the diagonal gives s.
    """
    around = triangles - triangles.mean(axis=1, keepdims=True)
    gram = np.einsum("nik,nil->nkl", around, around)
    size = np.sqrt(np.einsum("nkk->nk", gram))
    across = gram / (size[:, :, None] * size[:, None, :])
    xy, yz, zx = across[:, 0, 1], across[:, 1, 2], across[:, 2, 0]
    slope_sq = np.abs(np.stack([xy * zx / yz, xy * yz / zx, yz * zx / xy], axis=1))
    normal_sq = slope_sq / (1 + slope_sq)
    edge_sq = 2 * 0.05**2  # from (-0.025, 0.025, 0.025) to (0.025, -0.025, 0.025)
    return np.sqrt(normal_sq), size / np.sqrt(edge_sq / 2 * (1 - normal_sq))


def _euler_normals() -> NDArray[np.float64]:
    """The diagonal (1, 1, 1) turned about X, then Y, then Z, by even angles: in plain steps."""
    x, y, z = np.full((3, 20000), 1 / math.sqrt(3))
    a, b, c = np.random.default_rng(99).uniform(-math.pi, math.pi, size=(3, 20000))
    y, z = y * np.cos(a) - z * np.sin(a), y * np.sin(a) + z * np.cos(a)
    z, x = z * np.cos(b) - x * np.sin(b), z * np.sin(b) + x * np.cos(b)
    x, y = x * np.cos(c) - y * np.sin(c), x * np.sin(c) + y * np.cos(c)
    return np.column_stack([x, y, z])


STATED = {
    "pretrain-256": Stated(rows=DEFAULT, published=False),
    "renderformer-v1-256": Stated(rows=STAGE_1, published=True),
    "renderformer-v1-512": Stated(rows=STAGE_2, published=True),
}


def _table(scenes: list[Drawn], stated: Stated) -> Table:
    poses = [placement.pose for one in scenes for placement in one.layout.objects]
    table = {
        **plan_table(scenes, stated),
        **rotation_table([pose.rotation for pose in poses], euler=stated.published),
        **emitter_table(
            [emitter for one in scenes for emitter in one.layout.emitters],
            [one.plan.num_lights for one in scenes for _ in one.layout.emitters],
            euler=stated.published,
        ),
        **_surface_tables(scenes, stated),
    }
    if stated.published:
        centres = np.stack([pose.centre for pose in poses])
        for axis, name in enumerate("xyz"):
            table[f"centre {name}"] = uniform(centres[:, axis], -0.5, 0.5)
        for low, high in sorted({row[3] for row in stated.rows}):
            found = [
                4 * placement.pose.radius
                for one in scenes
                for placement in one.layout.objects
                if stated.row_of(one)[3] == (low, high)
            ]
            table[f"sizes {low} to {high}"] = uniform(found, low, high)
    return table


def _surface_tables(scenes: list[Drawn], stated: Stated) -> Table:
    table: dict[str, float] = {}
    for smooth_share in {row[4] for row in stated.rows}:
        chosen = [one.layout for one in scenes if stated.row_of(one)[4] == smooth_share]
        for kind in ("shell", "object"):
            surfaces = [
                part.surface
                for layout in chosen
                for part in (layout.shell if kind == "shell" else layout.objects)
            ]
            share_ = 1.0 if kind == "shell" else 0.5 * (not stated.published)
            rows = surface_table(surfaces, smooth_share=smooth_share, by_triangle=share_)
            special = " special" if smooth_share == 0.25 else ""
            table |= {f"{kind} {name}{special}": p for name, p in rows.items()}
    return table


@pytest.mark.parametrize(
    "build",
    [
        pytest.param("pretrain-256", marks=pytest.mark.slow("statistics")),
        "renderformer-v1-256",
        pytest.param("renderformer-v1-512", marks=pytest.mark.slow("statistics")),
    ],
)
def test_everything_is_distributed_as_stated(build: str) -> None:
    require_plausible(_table(drawn(preset_settings(build).scenes, MANY), STATED[build]))


def test_the_second_training_stage_draws_the_same() -> None:
    """Its budget, and how finely it is spent, are all that differs: one table stands for both."""
    pretrain, finetune = (preset_settings(name).scenes for name in ("pretrain-256", "finetune-512"))
    same = dataclasses.replace(
        finetune, max_triangles=pretrain.max_triangles, enough_error=pretrain.enough_error
    )
    assert same == pretrain
    assert (finetune.max_triangles, finetune.enough_error) == (4096, 0.0025)

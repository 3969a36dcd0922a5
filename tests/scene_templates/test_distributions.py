"""Every quantity that is drawn is distributed as stated, for our settings and published ones.

2000 layouts per setting with balls for objects. See `statistics` for the line that is drawn.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from pipeline.builds.named import named_build
from scene_templates.settings import SceneSettings
from storage.settings.changes import changed
from tests.scene_templates.balls import MANY, Drawn, drawn
from tests.scene_templates.published import DEFAULT, STAGE_1, STAGE_2, Row
from tests.scene_templates.sampled_facts import (
    Stated,
    emitter_table,
    plan_table,
    rotation_table,
    surface_table,
)
from tests.scene_templates.statistics import Table, implausible, require_plausible, uniform


def _stated(rows: tuple[Row, ...], *, published: bool) -> Stated:
    return Stated(
        weights={name: weight for name, weight, *_ in rows},
        counts={name: counts for name, _, counts, *_ in rows},
        scales={name: scale for name, _, _, scale, _ in rows},
        flatter=frozenset(row[0] for row in rows if row[-1] == 0.25),
        overlap_share=1.0 if published else 0.1,
        published=published,
        triangle_colours_share=0.0 if published else 0.5,
    )


FEWER = 1200
"""Scenes in which everything that is wrong below is noticed."""

STATED = {
    "pretrain-256": _stated(DEFAULT, published=False),
    "renderformer-v1-256": _stated(STAGE_1, published=True),
    "renderformer-v1-512": _stated(STAGE_2, published=True),
}


def _settings(build: str) -> SceneSettings:
    return named_build(build).scenes


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
        for low, high in sorted(set(stated.scales.values())):
            found = [
                4 * placement.pose.radius
                for one in scenes
                for placement in one.layout.objects
                if stated.scales[one.plan.family.name] == (low, high)
            ]
            table[f"sizes {low} to {high}"] = uniform(found, low, high)
    return table


def _surface_tables(scenes: list[Drawn], stated: Stated) -> Table:
    table: dict[str, float] = {}
    for flatter in {name in stated.flatter for name in stated.weights}:
        chosen = [
            one.layout for one in scenes if (one.plan.family.name in stated.flatter) == flatter
        ]
        for kind in ("shell", "object"):
            surfaces = [
                part.surface
                for layout in chosen
                for part in (layout.shell if kind == "shell" else layout.objects)
            ]
            rows = surface_table(
                surfaces,
                kind=kind,
                smooth_share=0.25 if flatter else 0.5,
                triangle_colours_share=stated.triangle_colours_share,
            )
            table |= {
                f"{kind} {name}{' special' if flatter else ''}": p for name, p in rows.items()
            }
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
    require_plausible(_table(drawn(_settings(build), MANY), STATED[build]))


def test_the_second_training_stage_draws_the_same() -> None:
    """Its budget, and how finely it is spent, are all that differs: one table stands for both."""
    pretrain, finetune = _settings("pretrain-256"), _settings("finetune-512")
    same = dataclasses.replace(
        finetune, max_triangles=pretrain.max_triangles, enough_error=pretrain.enough_error
    )
    assert same == pretrain
    assert (finetune.max_triangles, finetune.enough_error) == (4096, 0.0025)


def test_published_stages_differ_in_families_and_budget_only() -> None:
    for suffix in ("", "-original"):
        first = _settings(f"renderformer-v1-256{suffix}")
        second = _settings(f"renderformer-v1-512{suffix}")
        assert dataclasses.replace(second, families=first.families, max_triangles=1572) == first
        assert (first.max_triangles, second.max_triangles) == (1572, 4192)


WRONG: list[tuple[str, Mapping[str, Any], set[str]]] = [
    (
        "renderformer-v1-256",
        {
            "families.weight": 1.0,
            "lights.count": [1, 7],
            "lights.scale": [2.0, 2.45],
            "placement.overlap_share": 0.9,
            "placement.orientation": "uniform",
            "materials.albedo_sum": [0.91, 1.0],
            "materials.roughness_log": [0.1, 1.055],
            "materials.coloured_share": 0.7,
            "families.object_scale": [0.8, 1.5],
            "families.smooth_share": 0.6,
            "placement.inside": True,
            "lights.total_emission": [2500, 4700],
            "materials.specular_ratio": [0.0, 0.9],
            "materials.roughness_clip": [0.03, 1.0],
            "materials.coloured_specular_share": 0.01,
        },
        {"families", "light counts", "scale x", "scale y", "scale z", "overlaps", "euler y"}
        | {"object albedo sum", "shell albedo sum", "object coloured", "shell coloured"}
        | {"object roughness", "shell roughness"}
        | {"sizes 0.8 to 1.8", "sizes 1.4 to 1.6", "object smooth", "shell smooth special"}
        | {"centre x", "centre y", "centre z", "radiance"}
        | {"object specular ratio", "object roughness", "object specular is grey"},
    ),
    (
        "pretrain-256",
        {
            "families.num_objects": [1, 2],
            "lights.coloured_share": 0.01,
            "placement.overlap_share": 1.0,
            "lights.orientation": "euler",
            "placement.orientation": "euler",
            "materials.triangle_colours_share": 0.0,
        },
        {"object counts 1 to 1", "object counts 2 to 3", "white", "normal z", "entry 0 0"}
        | {"object by triangle", "overlaps"},
    ),
]
"""A build, what is changed behind its back, and some of what must be noticed."""


@pytest.mark.parametrize(("build", "changes", "rows"), WRONG, ids=["ranges", "kinds"])
def test_a_wrong_distribution_is_noticed(
    build: str, changes: Mapping[str, Any], rows: set[str]
) -> None:
    wrong = changed(_settings(build), changes)
    table = _table(drawn(wrong, FEWER), STATED[build])
    assert rows <= set(implausible(table))
    # What has not been changed is not blamed.
    unchanged = {"object red", "object green", "object blue", "shell red", "shell green"}
    assert not unchanged & set(implausible(table))

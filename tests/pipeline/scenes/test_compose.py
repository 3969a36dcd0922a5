"""Laws of composed scenes, the same bytes in any process, and the triangle budget."""

import concurrent.futures
import contextlib
import dataclasses
import functools
import itertools
import json
import multiprocessing
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from pipeline.renders.tracer import choose_tracing_scale
from pipeline.scenes import triangle_budget
from pipeline.scenes.pieces import shell_piece
from pipeline.scenes.triangle_budget import (
    FitTable,
    PooledAsset,
    draw_rows,
    levels_within,
)
from pipeline.scenes.views import require_valid
from scene_templates.layout import ShellPart
from scene_templates.sample_layout import scene_plan
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected, TrilightError
from storage.licences import share_alike_camp
from storage.records.asset import Asset, Level, LevelRecord
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest
from storage.seeds import SceneKey
from storage.settings.overrides import apply_overrides
from tests.for_each import for_each
from tests.pipeline.scenes.small_pool import (
    BLIND,
    LOOK,
    QUALITY,
    SOURCE,
    TOUCH,
    composed,
    counts_of,
    digest,
    first_scene,
    fit_table,
    planes_of,
    points_of,
    rows_of,
    small_pool,
    with_error,
)
from tests.scene_templates.balls import DEFAULTS as SETTINGS
from tests.scene_templates.balls import template_settings


def test_attempts_differ_but_keep_what_was_planned(pool: list[PooledAsset]) -> None:
    for index in range(5):
        plan = scene_plan(SETTINGS, seed=0, scene_index=index)
        tries = []
        for attempt in range(4):
            with contextlib.suppress(Rejected):
                scene = composed(SETTINGS, pool, SceneKey(0, index, attempt))
                tries.append(scene)
        assert len({digest(scene) for scene in tries}) == len(tries) >= 2
        for scene in tries:
            assert scene.provenance["template"] == plan.family.template
            assert scene.provenance["family"] == plan.family.name
            assert len(rows_of(scene, "object")) == plan.num_objects
            assert len(rows_of(scene, "emitter")) == plan.num_lights


WITH_MAPS_OR_MANY_TRIANGLES = ("olat", "out-of-range", "out-of-range-2", "sky-256", "textured-256")
PLAIN = {*DATASET_PRESETS} - {*WITH_MAPS_OR_MANY_TRIANGLES, "benchmark-v1-mini", "object-views"}
"""An object alone has as many triangles as it needs."""


@pytest.mark.parametrize(
    ("names", "scenes"),
    [
        (("smoke", "finetune-512"), 16),
        pytest.param(sorted(PLAIN), 40, marks=pytest.mark.slow("every")),
        pytest.param(WITH_MAPS_OR_MANY_TRIANGLES, 16, marks=pytest.mark.slow("every")),
    ],
    ids=["two", "plain", "others"],
)
def test_no_build_exceeds_its_budget(
    pool: list[PooledAsset], names: Sequence[str], scenes: int
) -> None:
    """Shell and lights included; and each preset has scenes that come near its budget."""
    for name in names:
        settings = preset_settings(name, changes={"scenes.num_views": 1}).scenes
        fullest = 0.0
        for index in range(scenes):
            after = settings.of_scene(index)
            with contextlib.suppress(Rejected):
                scene = composed(settings, pool, SceneKey(2, index))
                fullest = max(fullest, scene.num_triangles / after.max_triangles)
                assert choose_tracing_scale(scene) == 1, "no preset's pictures change by a size"
                counts, template = counts_of(scene), TEMPLATES[scene.provenance["template"]]
                planned = scene_plan(settings, seed=2, scene_index=index).num_objects
                assert counts["shell"] == template.shell_triangles
                assert (counts["object"] > 0) == (planned > 0)  # benchmark-v1 has empty shells
        # A level of the small pool is a quarter of the next finer one: little is ever left.
        assert 0.75 < fullest <= 1, (name, fullest)


def test_scenes_keep_the_laws_of_the_record_emitters_objects_and_normals(
    scenes: list[Scene],
) -> None:
    for scene in scenes:
        scene.check()
        assert scene.num_views == SETTINGS.num_views
        assert scene.num_triangles <= SETTINGS.max_triangles
        assert json.loads(json.dumps(dict(scene.provenance))) == scene.provenance
        names = {"template", "family", "scene_index", "attempt", "seed", "camera_attempts"}
        assert set(scene.provenance) == names
        kinds = [entry.kind for entry in scene.objects]
        assert kinds == sorted(kinds, key=("shell", "object", "emitter").index)
        emits = scene.triangle_emits
        rows = scene.material_index[emits]
        assert 1 <= len(set(rows.tolist())) == len(rows) <= 8
        material = scene.materials[rows]
        assert 2500 <= material[:, 7].sum() <= 5000.01  # eight float32 roundings of up to 3e-5
        assert (material[:, 7:] == material[:, 7:8]).all()
        assert (material[:, :6] == 0).all()
        assert len(set(scene.object_index[emits].tolist())) == len(rows)
        planes = planes_of(scene)
        for row in rows_of(scene, "object"):
            points = points_of(scene, row)
            assert (points @ planes[:, :3].T + planes[:, 3]).min() > -TOUCH
            assert np.abs(points).max() < 1.2  # beside the room by half a radius at most
        corners = scene.vertex_positions[scene.faces].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        geometric = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        facing = np.einsum("tci,ti->tc", scene.vertex_normals[scene.faces], geometric)
        assert facing.min() > 0.1 - 1e-6  # shading.LEAST_FACING, less float32 rounding


def test_rights_travel_and_names_are_unique(pool: list[PooledAsset]) -> None:
    wall = [entry for entry in pool if entry.locked.uid == "made/wall1"]
    settings = template_settings("corner", {"families.num_objects": [3, 3], "num_views": 1})
    scene = composed(settings, wall, SceneKey(0, 0))
    objects = [entry for entry in scene.objects if entry.kind == "object"]
    assert [entry.name for entry in objects] == ["wall1_2", "wall1_3", "wall1_4"]
    for entry in objects:
        assert entry.uid == "made/wall1"
        assert entry.licence == "CC0-1.0"
        assert entry.attribution == "maker of made/wall1"
        assert entry.source_url == "https://example.org/made/wall1"


def test_a_scene_without_objects_is_a_scene(pool: list[PooledAsset]) -> None:
    """The published families have some; a view of one need not show any object."""
    settings = template_settings("open_box", {"families.num_objects": [0, 0]})
    scene = composed(settings, pool, SceneKey(0, 0))
    scene.check()
    assert rows_of(scene, "object") == []
    assert len(scene.provenance["camera_attempts"]) == scene.num_views == 4


def test_real_objects_compose(real_pool: list[PooledAsset]) -> None:
    """Thin, open, doubled and many-part meshes as people publish them keep every law."""
    for index in range(12):
        scene = first_scene(SETTINGS, real_pool, seed=0, scene_index=index)
        scene.check()
        assert scene.num_triangles <= SETTINGS.max_triangles


CROWD = {"families.num_objects": [3, 3], "placement.overlap_share": 0.0}

PROVOKED: list[tuple[str, str, Mapping[str, Any], str]] = [
    ("no_room", "open_box", {**CROWD, "families.object_scale": [2.0, 2.0]}, "3 objects met"),
    (
        "over_budget",
        "plane",
        {**CROWD, "lights.count": [8, 8], "max_triangles": 171},  # 3 objects of 12 need 172
        "3 objects of at least 12 triangles each do not fit into the 35",
    ),
    ("no_camera", "wall", {"views.min_coverage": 1.0}, "sees too little of the objects x16"),
    ("no_camera", "open_box", {"lights.count": [1, 1], "views.min_lit": 1.0}, "too little light"),
    ("no_camera", "wall", {"views.min_depth": 5.0}, "too near x16"),
    (
        "emitter_inside",
        "plane",
        {**BLIND, **CROWD, "lights.distance": [0.1, 0.1], "lights.count": [8, 8]},
        "reaches into the box of an object",
    ),
]


@for_each(("reason", "template", "changes", "message"), PROVOKED)
def test_each_reason_is_given_where_it_holds(
    pool: list[PooledAsset], reason: str, template: str, changes: Mapping[str, Any], message: str
) -> None:
    settings = template_settings(template, changes)
    found = []
    for _ in range(2):
        with pytest.raises(Rejected) as caught:
            composed(settings, pool, SceneKey(0, 0))
        found.append(caught.value)
    assert found[0].reason == reason
    assert message in found[0].message
    assert (found[0].reason, found[0].message) == (found[1].reason, found[1].message)


DAMAGES: dict[str, tuple[Any, float]] = {
    "one vertex is no number": (0, np.nan),
    "one is infinite": ((0, 1), np.inf),
    "all are one point": (slice(None), 0),
    "all are on one line": ((slice(None), slice(1, None)), 0),
}
"""Which positions have which value."""


def _damaged(entry: PooledAsset, damage: str) -> PooledAsset:
    """The same object with some positions of every level changed."""
    place, value = DAMAGES[damage]
    levels = []
    for level in entry.asset.levels:
        positions = level.positions.copy()
        positions[place] = value
        levels.append(dataclasses.replace(level, positions=positions))
    asset = dataclasses.replace(entry.asset, levels=tuple(levels))
    return dataclasses.replace(entry, asset=asset)


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.parametrize("build", ["smoke", "renderformer-v1-256"])
def test_a_mesh_without_usable_triangles_is_rejected(pool: list[PooledAsset], build: str) -> None:
    """The asset stage keeps such levels out; one that came through all the same costs one scene.

    An overlapping scene never asks for collisions, and one that does not would hand FCL a mesh of
    nothing: both must end alike.
    """
    settings = preset_settings(build, changes={"scenes.num_views": 1}).scenes
    overlapping = apply_overrides(settings, {"placement.overlap_share": 1.0})
    for damage, each, index in itertools.product(DAMAGES, (settings, overlapping), range(4)):
        try:
            scene = composed(each, [_damaged(pool[1], damage)], SceneKey(0, index))
        except Rejected as rejection:
            assert rejection.reason == "no_faces", (damage, rejection)
            assert "made/box" in rejection.message
            continue
        assert not any(entry.kind == "object" for entry in scene.objects), damage


def test_a_wall_without_area_is_called_by_its_name() -> None:
    """A layout of a user's may have one; it has no uid."""
    faces = np.array([[0, 1, 2]], np.uint32)
    flat = ShellPart(name="wall9", positions=np.zeros((3, 3)), faces=faces, surface=LOOK)
    with pytest.raises(Rejected, match="^no_faces: wall9: "):
        shell_piece(flat, np.random.default_rng(0), 30.0)


def test_what_a_scene_must_be_is_looked_at_last(scenes: list[Scene]) -> None:
    """Of a scene that is fine, each law by itself.

    An emitter in the box of an object is found, and one beside it is not.
    """
    settings = preset_settings("smoke").scenes
    scene = next(scene for scene in scenes if scene.num_triangles > 1000)
    require_valid(scene, settings)
    require_valid(scene, dataclasses.replace(settings, max_triangles=scene.num_triangles))
    tight = dataclasses.replace(settings, max_triangles=scene.num_triangles - 1)
    with pytest.raises(Rejected, match="^over_budget: "):
        require_valid(scene, tight)
    normals = scene.vertex_normals.copy()
    normals[0] = 0
    with pytest.raises(Rejected, match="^law_broken: .*vertex_normals"):
        require_valid(dataclasses.replace(scene, vertex_normals=normals), settings)
    kinds = [entry.kind for entry in scene.objects]
    emitter, body = len(kinds) - 1, kinds.index("object")
    vertices = scene.faces[scene.object_index == emitter].ravel()
    target = scene.vertex_positions[scene.faces[scene.object_index == body].ravel()]
    middle, top = (target.min(axis=0) + target.max(axis=0)) / 2, target[:, 2].max()
    for height, inside in ((middle[2], True), (top - 1e-3, True), (top + 1e-3, False)):
        # Its lowest corner over the middle of the object, below the top of its box or above.
        moved = scene.vertex_positions.copy()
        corners = moved[vertices]
        moved[vertices] += np.array([*middle[:2], height], np.float32) - np.array(
            [*corners[:, :2].mean(axis=0), corners[:, 2].min()], np.float32
        )
        lit = dataclasses.replace(scene, vertex_positions=moved)
        refused = pytest.raises(Rejected, match="^emitter_inside: ")
        with refused if inside else contextlib.nullcontext():
            require_valid(lit, settings)


SCENES = {
    "pretrain-256": tuple(range(8)),
    "renderformer-v1-512": tuple(range(8)),
    "out-of-range": (0, *range(5, 37, 4)),
}
"""Of the last, one with many triangles, and one of every other axis."""


def composed_digest(build: str, seed: int, index: int) -> str:
    """Compose one scene with the small pool; the work of one process."""
    settings = preset_settings(build).scenes
    return digest(first_scene(settings, small_pool(), seed=seed, scene_index=index))


def _digests(build: str, order: Sequence[int], seed: int = 0) -> dict[int, str]:
    return {index: composed_digest(build, seed, index) for index in order}


def _from_workers(workers: int) -> dict[str, dict[int, str]]:
    """Compose all scenes in so many new processes, the last scene first."""
    hold = functools.partial(os.sched_setaffinity, 0, [min(os.sched_getaffinity(0))])
    with concurrent.futures.ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=hold if workers == 1 else None,
    ) as executor:
        jobs = {
            build: {
                each: executor.submit(composed_digest, build, 0, each) for each in reversed(indices)
            }
            for build, indices in SCENES.items()
        }
        return {
            build: {index: job.result() for index, job in of_build.items()}
            for build, of_build in jobs.items()
        }


@pytest.mark.slow("kills")
def test_one_and_three_processes_make_the_same_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of them is held to one processor and one thread, which no other is."""
    here = {build: _digests(build, indices) for build, indices in SCENES.items()}
    for workers in (3, 1):
        if workers == 1:
            for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
                monkeypatch.setenv(name, "1")
        assert _from_workers(workers) == here
    # The comparison can fail: other scenes and other presets are other bytes.
    count = sum(len(indices) for indices in SCENES.values())
    assert len({sha for scenes in here.values() for sha in scenes.values()}) == count


def test_order_does_not_matter_and_seed_zero_is_a_seed() -> None:
    forward = _digests("pretrain-256", [0, 1, 2, 3, 4, 5])
    assert forward == _digests("pretrain-256", [5, 3, 1, 4, 2, 0])
    other = _digests("pretrain-256", [0, 1, 2, 3, 4, 5], seed=1)
    assert len({*forward.values(), *other.values()}) == 12


def test_what_is_planned_does_not_depend_on_the_pool(pool: list[PooledAsset]) -> None:
    """Which objects a scene holds may change with the pool, its kind may not."""
    for build, indices in SCENES.items():
        settings = preset_settings(build).scenes
        for index in indices[1:5]:
            few, many = (
                first_scene(settings, entries, seed=0, scene_index=index)
                for entries in (pool[:4], pool)
            )
            for name in ("template", "family", "scene_index", "seed"):
                assert few.provenance[name] == many.provenance[name]
            kinds = [[entry.kind for entry in scene.objects] for scene in (few, many)]
            assert kinds[0] == kinds[1]


def _asset(rungs: list[tuple[int, float]]) -> Asset:
    """Return an asset of levels with so many triangles and such an error."""
    levels = tuple(
        Level(
            record=LevelRecord(budget=count, method="by hand", quality=with_error(QUALITY, error)),
            positions=np.zeros((3, 3), np.float32),
            faces=np.zeros((count, 3), np.uint32),
        )
        for count, error in sorted(rungs, reverse=True)
    )
    return Asset(
        geometry_sha256="", source_sha256="", recipe="by hand", source=SOURCE, levels=levels
    )


def _sample_assets(rng: np.random.Generator, most: int = 4) -> list[Asset]:
    """Assets whose error falls with every triangle more, as it should."""
    assets = []
    for _ in range(rng.integers(1, most + 1)):
        counts = np.unique(rng.integers(4, 1200, size=rng.integers(1, 5)))
        errors = np.sort(rng.choice(np.linspace(0, 0.05, 26), size=len(counts)))[::-1]
        assets.append(_asset(list(zip(counts.tolist(), errors.tolist(), strict=True))))
    return assets


def _error(level: Level) -> float:
    return level.record.quality.error_p99


def _count(levels: tuple[Level, ...]) -> int:
    return sum(len(level.faces) for level in levels)


def test_the_worst_error_is_the_least_that_the_budget_allows() -> None:
    """Against all combinations: greedy is exact, since each step was needed to get below an error.

    Errors below enough count as enough.
    """
    rng = np.random.default_rng(1)
    compared = better = 0
    for _ in range(400):
        assets, total = _sample_assets(rng, most=3), int(rng.integers(100, 2500))
        enough = float(rng.choice([0.0, 0.01]))
        combinations = itertools.product(*(asset.levels for asset in assets))
        fitting = [levels for levels in combinations if _count(levels) <= total]
        if not fitting:
            with pytest.raises(Rejected):
                levels_within(assets, total, enough)
            continue
        worst = [max(enough, *(_error(level) for level in levels)) for levels in fitting]
        levels = levels_within(assets, total, enough)
        assert max(enough, *(_error(level) for level in levels)) == min(worst)
        left = total - _count(levels)
        assert left >= 0
        for asset, level in zip(assets, levels, strict=True):
            finer = [len(one.faces) for one in asset.levels if len(one.faces) > len(level.faces)]
            if finer and _error(level) > enough:
                assert min(finer) - len(level.faces) > left, "what is wanted would still fit"
        compared += 1
        better += min(worst) < max(worst)
    assert compared > 200
    assert better > 100  # else any choice would do


def test_too_little_room_is_rejected_with_the_numbers_and_an_empty_pool_is_a_mistake() -> None:
    with pytest.raises(TrilightError, match="pool"):
        composed(SETTINGS, [], SceneKey(0, 0))
    with pytest.raises(Rejected, match="1 objects need 300 triangles at least.*has 200"):
        levels_within([_asset([(300, 0.1), (600, 0.0)])], 200, 0.0)
    with pytest.raises(Rejected, match="^over_budget: 3 objects of at least 50 .* into the 149"):
        draw_rows(np.random.default_rng(0), fit_table([50, 80]), 3, 149)
    with pytest.raises(Rejected, match="do not fit"):
        draw_rows(np.random.default_rng(0), fit_table([5, 5], ["a", "b"]), 3, 14)


LICENCES = ("CC-BY-SA-4.0", "CC-BY-SA-3.0", "CC0-1.0", "cc-by-sa-4.0", "GPL-3.0-only")


def _scenes(licences: Sequence[str], count: int) -> list[Scene]:
    pool = [
        dataclasses.replace(entry, locked=dataclasses.replace(entry.locked, licence=licence))
        for entry, licence in zip(small_pool(), licences, strict=True)
    ]
    return [first_scene(SETTINGS, pool, seed=5, scene_index=index) for index in range(count)]


def test_no_scene_mixes_two_share_alike_licences_and_one_changes_none() -> None:
    camps = Counter[frozenset[str]]()
    for scene in _scenes(LICENCES, 30):
        uids = {entry.uid for entry in scene.objects if entry.kind == "object"}
        met = {entry.licence for entry in scene.objects if entry.uid in uids}
        camps[frozenset(filter(None, map(share_alike_camp, met)))] += 1
    assert max(len(met) for met in camps) == 1
    assert len(camps) == 4  # each of the three licences, and none: the draw reaches them all
    # Frozen sets stay what they are: a rule that does not bind takes no number.
    usual = [scene_digest(scene) for scene in _scenes(["CC0-1.0"] * 5, 6)]
    one = [scene_digest(scene) for scene in _scenes(["CC-BY-SA-4.0", *["MIT"] * 4], 6)]
    assert one == usual


def _slow_twin(
    rng: np.random.Generator, least: Sequence[int], camps: Sequence[str], count: int, total: int
) -> list[int] | None:
    """Look at every row for each object, and at every row after each of them."""
    allowed, left, drawn = set(range(len(least))), total, list[int]()
    for following in range(count - 1, -1, -1):
        fitting_rows = []
        for row in sorted(allowed):
            camps_beside = ("", camps[row]) if camps[row] else camps
            beside = [least[other] for other in allowed if camps[other] in camps_beside]
            if least[row] + following * min(beside) <= left:
                fitting_rows.append(row)
        if not fitting_rows:
            return None
        row = fitting_rows[int(rng.integers(len(fitting_rows)))]
        drawn.append(row)
        left -= least[row]
        if camps[row]:
            allowed = {other for other in allowed if camps[other] in ("", camps[row])}
    return drawn


def test_parts_change_no_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triangle_budget, "_CHUNK", 7)
    rejected = several = 0
    for trial in range(300):
        rng = np.random.default_rng(trial)
        num_rows, count = int(rng.integers(1, 40)), int(rng.integers(1, 5))
        least = rng.integers(1, 100, num_rows).tolist()
        camps = rng.choice(["", "", "a", "b"], num_rows).tolist()
        total = int(rng.integers(1, 300))
        expected = _slow_twin(np.random.default_rng(trial), least, camps, count, total)
        table = fit_table(least, camps)
        try:
            assert draw_rows(np.random.default_rng(trial), table, count, total) == expected
        except Rejected:
            assert expected is None
        rejected += expected is None
        several += bool(expected) and max(expected or [0]) >= 7
    assert 15 < rejected < 150
    assert several > 75


def test_no_row_is_looked_at_where_all_fit() -> None:
    """Of a million objects, two are read for each that is drawn."""

    class Counting:
        def __init__(self, values: Sequence[int]) -> None:
            self.values, self.read = np.array(values), 0

        def __len__(self) -> int:
            return len(self.values)

        def __getitem__(self, rows: slice) -> np.ndarray:
            found = self.values[rows]
            self.read += len(found)
            return found

    least, camp = Counting(range(1, 1001)), Counting([0] * 1000)
    table = FitTable(least, camp, [""], fit_table(range(1, 1001)).sizes)
    draw_rows(np.random.default_rng(0), table, 3, 3000)
    assert (least.read, camp.read) == (3, 3)
    draw_rows(np.random.default_rng(0), table, 3, 2000)
    assert least.read > 1000

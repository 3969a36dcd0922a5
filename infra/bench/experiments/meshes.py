"""Experiment `meshes`: decimation methods, RenderFormer's recipe, and every budget of triangles.

For pictures one object is on a floor under one lamp; camera, material and random numbers are equal
for all of its meshes. Meshes are made in a mesh child, and rendered in a render child.
"""

import contextlib
import dataclasses
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point, percent
from infra.bench.workloads.named_scenes import plain_surface, quad, scene_of_pieces
from infra.bench.workloads.traced_pictures import fixed_samples
from infra.bench_options import BenchOptions
from pipeline.assets.cleaning.clean import clean, normalize
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.decimation.decimate import decimate
from pipeline.assets.quality.measure import MeasuredSource
from pipeline.assets.settings import AssetSettings
from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import load_mesh, read_source
from pipeline.isolation import ChildFailed
from pipeline.objects.sources import list_objects
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.scenes.pieces import emitter_piece, shell_piece, surface_piece
from scene_templates.layout import Emitter
from storage.cache import cache_folder
from storage.conventions import look_at_c2w
from storage.errors import Rejected
from storage.metrics import psnr_log_db
from storage.records.scene import Scene, SceneObject

REFERENCE = "reference recipe"
"""Method: isotropic remeshing at 0.5 % of the diagonal, then quadric collapse, without cleaning;
the public tool of RenderFormer's first version."""

METHODS: Mapping[str, str] = {
    "faithful": "pymeshlab_collapse",
    "faithful, GPL-free": "meshoptimizer",
    "uniform": "pymeshlab_uniform",
}
"""Trilight's methods by the name of their decimation; cleaning and orientation are included."""

_SMOOTH_ANGLE_DEG = 30.0
_EYE = (1.6, -1.6, 1.0)
_FOV_DEG = 35.0
_LAMP = ((0.8, -1.2, 2.0), (1.3, -0.9, 2.0), (0.9, -0.7, 2.2))
_RADIANCE = 200.0
"""Radiance that gives pictures the median brightness of `smoke`, 0.23, on which dB depend."""


def raw_mesh(path: Path) -> TriangleMesh:
    """Return the mesh of a file in nominal size, neither cleaned nor oriented; raises Rejected."""
    return normalize(load_mesh(read_source(path, ReadLimits())))


def clean_mesh(raw: TriangleMesh) -> TriangleMesh:
    """Return a raw mesh as the mesh stage decimates it; raises Rejected."""
    return orient_outward(clean(raw))[0]


def count_faces(path: Path) -> int:
    """Return the number of triangles of a source after cleaning; raises Rejected."""
    return len(clean(raw_mesh(path)).faces)


def remesh(path: Path, side: str, budget: int) -> dict[str, float]:
    """Return CPU seconds and quality of one object at one budget; raises Rejected.

    Loading the file and measuring the result are not counted, since every method needs them.
    """
    raw = raw_mesh(path)
    source = clean_mesh(raw)
    started = time.process_time()
    if side == REFERENCE:
        result = _simplify_by_reference(raw, budget)
    else:
        result = decimate(clean_mesh(raw), budget, METHODS[side])
    cpu_s = time.process_time() - started
    mesh = clean(result)
    quality = MeasuredSource(source).quality(mesh)
    return {
        "cpu_s": cpu_s,
        "faces": len(mesh.faces),
        "error_mean": quality.error_mean,
        "error_p99": quality.error_p99,
        "area_variation": quality.area_variation,
        "min_angle_p5_deg": quality.min_angle_p5_deg,
    }


def _simplify_by_reference(raw: TriangleMesh, budget: int) -> TriangleMesh:
    import pymeshlab  # which may be missing

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(raw.positions, raw.faces.astype(np.int32)))
    meshes.meshing_isotropic_explicit_remeshing(
        targetlen=pymeshlab.PercentageValue(0.5), featuredeg=30.0
    )
    meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=budget, qualitythr=1.0)
    result = meshes.current_mesh()
    return TriangleMesh(
        positions=result.vertex_matrix(), faces=result.face_matrix().astype(np.int64)
    )


def make_coarser_meshes(path: Path, budgets: Sequence[int], method: str) -> list[TriangleMesh]:
    """Return the cleaned source of a file, and one mesh for each budget; raises Rejected."""
    source = clean_mesh(raw_mesh(path))
    meshes = [source, *(clean(decimate(source, budget, method)) for budget in budgets)]
    return [
        TriangleMesh(  # of the declared types: a mesh leaves its child with no other
            positions=np.ascontiguousarray(mesh.positions, np.float64),
            faces=np.ascontiguousarray(mesh.faces, np.int64),
        )
        for mesh in meshes
    ]


def picture_db(meshes: Sequence[TriangleMesh], renders: RenderSettings) -> list[float]:
    """Return psnr_log_db of each further mesh, and of the first again, to the first's picture.

    The last value is the first mesh with other random numbers, which bounds the others.
    """

    def picture(mesh: TriangleMesh, seed: int) -> NDArray[np.float32]:
        scene = _scene(mesh, floor_z=float(meshes[0].positions[:, 2].min()))
        return SceneRenderer(scene, renders).render_view(scene.c2w[0], _FOV_DEG, seed).radiance_rgb

    source = picture(meshes[0], 0)
    pictures = [*(picture(mesh, 0) for mesh in meshes[1:]), picture(meshes[0], 1)]
    return [psnr_log_db(source, other) for other in pictures]


def _scene(mesh: TriangleMesh, *, floor_z: float) -> Scene:
    rng = np.random.default_rng(0)  # for materials of many colours, which these are not
    matt = plain_surface(0.5, 0.0, 1.0, smooth=False)
    glossy = dataclasses.replace(
        matt, diffuse_rgb=(0.5, 0.3, 0.2), specular_rgb=(0.3, 0.3, 0.3), roughness=0.4, smooth=True
    )
    corners = [[-2, -2, floor_z], [2, -2, floor_z], [2, 2, floor_z], [-2, 2, floor_z]]
    lamp = Emitter(triangle=np.array(_LAMP), radiance_rgb=(_RADIANCE,) * 3, reflectance=0.0)
    entry = SceneObject(name="object", kind="object")
    positions = mesh.positions.astype(np.float32)
    faces = mesh.faces.astype(np.uint32)
    pieces = [
        shell_piece(quad("floor", corners, matt), rng, _SMOOTH_ANGLE_DEG),
        surface_piece(entry, positions, faces, glossy, rng, _SMOOTH_ANGLE_DEG),
        emitter_piece(lamp, 0),
    ]
    return scene_of_pieces(
        pieces, look_at_c2w(eye=_EYE, target=(0, 0, 0), up=(0, 0, 1)), _FOV_DEG, {}
    )


BUDGET = 512
"""Number of triangles at which methods are compared."""
CURVE = (64, 128, 256, 512, 1024)
PICTURED = 3
"""Number of objects that are path traced at every budget, which takes some seconds each."""
LARGE = 1100
"""Minimum number of clean triangles of an object, so that every budget removes some."""
METHOD_GROUP = f"methods, {BUDGET} triangles"
BUDGET_GROUP = "faithful, by budget"


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    methods = [
        Point(
            name=f"{METHOD_GROUP}, {method}",
            measure=partial(_simplify, method, BUDGET),
            default=method == AssetSettings.profile,
            group=METHOD_GROUP,
            kind="methods",
        )
        for method in (REFERENCE, *METHODS)
    ]
    budgets = [
        Point(
            name=f"{BUDGET_GROUP}, {budget}",
            measure=partial(_simplify_and_render, budget),
            group=BUDGET_GROUP,
            kind="budgets",
        )
        for budget in CURVE
    ]
    return [*methods, *budgets]


def _simplify(method: str, budget: int, context: BenchContext, trial: str) -> Figures:
    return context.mesh_child.call(remesh, _object(context, trial), method, budget)


def _simplify_and_render(budget: int, context: BenchContext, trial: str) -> Figures:
    """Measure `faithful` at a budget, with pictures if the object is path traced."""
    figures = _simplify("faithful", budget, context, trial)
    if _number(trial) > PICTURED:
        return figures
    pictures = context.get_or_make(("pictures", trial), lambda: _picture_db(context, trial))
    return {
        **figures, "picture_db": pictures[CURVE.index(budget)], "again_db": pictures[-1]
    }  # fmt: skip


def _picture_db(context: BenchContext, trial: str) -> list[float]:
    method = METHODS["faithful"]
    meshes = context.mesh_child.call(make_coarser_meshes, _object(context, trial), CURVE, method)
    renders = fixed_samples(context.scale.picture_px, context.scale.max_spp // 4)
    return context.child.call(picture_db, meshes, renders)


def _object(context: BenchContext, trial: str) -> Path:
    large = context.get_or_make("large objects", lambda: _large_objects(context))
    if _number(trial) > len(large):
        raise Rejected("no_object", f"only {len(large)} objects have {LARGE} triangles")
    return large[_number(trial) - 1]


def _large_objects(context: BenchContext) -> list[Path]:
    """Return the files of usable objects of LARGE triangles after cleaning, largest first.

    Raises:
        TrilightError: as `list_objects`.
    """
    objects = list_objects(
        context.options.objects,
        work_dir=cache_folder("objects"),
        allowed_licences=context.options.allowed_licences,
    ).fetch_selected()
    sizes = {}
    for record in objects.records:
        with contextlib.suppress(Rejected, ChildFailed):
            sizes[Path(record.path)] = context.mesh_child.call(count_faces, Path(record.path))
    large = [(-faces, str(path), path) for path, faces in sizes.items() if faces >= LARGE]
    return [path for _, _, path in sorted(large)]


def _number(trial: str) -> int:
    return int(trial.split()[-1])


EXPERIMENT = Experiment(
    name="meshes",
    title="Coarser meshes: methods and budgets",
    cost=Column("core-seconds an object", "cpu_s"),
    error=Column("distance to the source, p99, % of the diagonal", "error_p99", then=percent),
    columns=(
        Column("triangles", "faces"),
        Column("mean distance, %", "error_mean", then=percent),
        Column("area variation", "area_variation"),
        Column("smallest angles, degrees", "min_angle_p5_deg"),
        Column("picture, psnr_log_db", "picture_db"),
        Column("the source with other samples, psnr_log_db", "again_db"),
    ),
    because="Distances are two-way, to the cleaned source; medians over the objects. `uniform` is "
    "for uses that need even triangles, at more error and more time.",
    points=_points,
    trials=lambda scale, options: [f"object {number}" for number in range(1, scale.objects + 1)],
)

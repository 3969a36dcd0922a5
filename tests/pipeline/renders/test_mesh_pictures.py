"""Pictures of coarser meshes beside that of the source: nearer with every level."""

import numpy as np
import trimesh

from infra.bench.workloads.mesh_pictures import picture_db
from infra.bench.workloads.shots import fixed_samples
from pipeline.assets.mesh import TriangleMesh


def _ball(subdivisions: int) -> TriangleMesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    return TriangleMesh(
        positions=np.asarray(mesh.vertices, np.float64), faces=np.asarray(mesh.faces, np.int64)
    )


def test_a_finer_ball_looks_more_like_its_source() -> None:
    """20480 triangles as the source, then 80, 320, 1280 and itself."""
    meshes = [_ball(5), _ball(1), _ball(2), _ball(3), _ball(5)]
    coarse, middle, fine, same, other_samples = picture_db(meshes, fixed_samples(32, 64))
    # a quarter of the distance with every step, 12 dB at most; a third of that is asked for
    assert coarse + 4 < middle and middle + 4 < fine
    assert same == 100.0  # equal meshes, equal random numbers, equal bits
    # denoised twice with other samples: far from equal, and far from another shape
    assert coarse < other_samples < 100

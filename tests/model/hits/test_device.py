"""Views whose rays a card traces: their code on the CPU's tensors, and the kernel beside Embree."""

import ctypes
import dataclasses
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from model.config import hit_stage
from model.hits.device_arrays import DeviceArray, DevicePlace
from model.hits.device_rays import SOURCE, DeviceTriangles, build_tree
from model.hits.tracing import traced_scene, with_traced
from model.neural_renderer import NeuralRenderer
from model.scene_tensors import scene_tensors
from storage.raycast.caster import RayHits
from storage.raycast.embree import Triangles
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.model.hits.kit import corner, lit_scene
from tests.model.hits.test_decoder import hits_config
from tests.model.hits.test_view_inputs import textured

CPU = torch.device("cpu")
needs_card = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


class _OnHost:
    """Embree for tensors of the CPU."""

    def __init__(self, corners: NDArray, rows: NDArray, place: DevicePlace) -> None:
        self._embree, self._place = Triangles(corners, rows), place

    def intersect(self, origins: DeviceArray, directions: DeviceArray) -> RayHits:
        met = self._embree.intersect(origins.tensor.numpy(), directions.tensor.numpy())
        uv = np.where(met.triangle >= 0, met.uv, np.float32(0))
        return RayHits(triangle=self._place.array(met.triangle), uv=self._place.array(uv))

    def is_free(self, *rays: DeviceArray) -> DeviceArray:
        return self._place.array(self._embree.is_free(*(each.tensor.numpy() for each in rays)))


@for_each("scene", [corner(), textured()])
def test_a_view_of_tensors_is_numpys(scene: Scene) -> None:
    numpy_form = traced_scene(lit_scene(scene))
    tensor_form = numpy_form.on_place(DevicePlace(CPU), _OnHost)
    camera = torch.tensor(scene.c2w[0]), torch.tensor(float(scene.fov_deg[0]))
    stage = hit_stage(dataclasses.replace(hits_config(), hit_rays=2, gather_rays=4))
    given = (*camera, 32, stage, 0)
    expected, got = numpy_form.view(*given), tensor_form.view(*given)
    for name, array in vars(expected).items():
        tensor = getattr(got, name).tensor
        np.testing.assert_allclose(tensor.numpy(), array, rtol=1e-3, atol=2e-5, err_msg=name)


def _rays(corners: NDArray, count: int) -> tuple[NDArray, NDArray, NDArray]:
    rng = np.random.default_rng(0)
    shares = rng.dirichlet([1, 1, 1], count)
    starts = np.einsum("nk,nki->ni", shares, corners[rng.integers(0, len(corners), count)])
    starts += rng.normal(size=starts.shape) * 0.3
    directions = rng.normal(size=starts.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    floats = [each.astype(np.float32) for each in (starts, directions, rng.uniform(0, 2, count))]
    return floats[0], floats[1], floats[2]


def _corners() -> NDArray[np.float32]:
    scene = textured()
    return scene.vertex_positions[scene.faces]


@for_each("count", [0, 1, 5, 545])
def test_the_kernel_meets_what_embree_meets(count: int, tmp_path: Path) -> None:
    """Its text, compiled for this processor: the triangle of each ray, and what is free."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++")
    before = "#include <math.h>\n#define __global__\n#define __device__\n"
    before += "static struct { int x; } blockIdx, blockDim, threadIdx;\n"
    source, library = tmp_path / "kernel.cpp", tmp_path / "kernel.so"
    source.write_text(before + SOURCE + 'extern "C" void at(int ray) { threadIdx.x = ray; }\n')
    command = [compiler, "-O1", "-shared", "-fPIC", str(source), "-o", str(library)]
    subprocess.run(command, check=True)
    compiled = ctypes.CDLL(str(library))
    corners, rows = _corners(), np.arange(count)
    tree = build_tree(corners[rows], rows)
    starts, directions, limits = _rays(corners, 4000)
    triangle, uv = np.zeros(4000, np.int64), np.zeros((2, 4000), np.float32)
    free = np.zeros(4000, np.bool_)
    arrays = (starts, directions, limits, tree.nodes, tree.corners,
              tree.rows, triangle, uv, free)  # fmt: skip
    pointers = [ctypes.c_void_p(each.ctypes.data) for each in arrays]
    for ray in range(4000):
        compiled.at(ray)
        for asks_free in (0, 1):
            compiled.trace(*pointers, 4000, asks_free)
    embree = Triangles(corners, rows)
    met = embree.intersect(starts, directions)
    # where the box stands on the floor, either is right
    assert (triangle == met.triangle).mean() > 0.99
    assert (free == embree.is_free(starts, directions, limits)).mean() > 0.999
    same = (triangle == met.triangle) & (triangle >= 0)
    np.testing.assert_allclose(uv[:, same], met.uv[:, same], atol=1e-3)


@needs_card
def test_a_card_shows_the_processors_picture() -> None:
    scene, card = textured(), torch.device("cuda")
    corners = _corners()
    starts, directions, _ = _rays(corners, 4000)
    rows, place = np.arange(len(corners)), DevicePlace(card)
    met = DeviceTriangles(corners, rows, place).intersect(
        place.array(starts), place.array(directions)
    )
    expected = Triangles(corners, rows).intersect(starts, directions).triangle
    assert (met.triangle.tensor.cpu().numpy() == expected).mean() > 0.99
    slow = NeuralRenderer.load("builtin:hits", device="cpu").render(scene, 64)[0]
    renderer = NeuralRenderer.load("builtin:hits", device="cuda")
    prepared = renderer.prepare(scene)
    for _ in range(3):  # one by one, recorded, repeated
        quick = renderer.view(prepared, scene.c2w[0], float(scene.fov_deg[0]), 64)
        assert np.abs(quick - slow).mean() < 1e-4 * slow.mean()
    tensors, config = scene_tensors(scene), hits_config()
    by_card = with_traced(tensors, 32, config, device=card).traced
    by_processor = with_traced(tensors, 32, config).traced
    assert by_card is not None and by_processor is not None
    torch.testing.assert_close(by_card.pixels_VRRC, by_processor.pixels_VRRC, rtol=1e-3, atol=1e-3)

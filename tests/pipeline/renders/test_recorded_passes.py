"""Passes that are replayed are those that are traced each time, in every bit."""

import gc
import itertools
import weakref
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.device_memory import read_back
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.recorded_calls import KernelInputs, record_launches
from pipeline.renders.tracer import Tracer
from pipeline.renders.vector_tracer import VectorTracer
from storage.records.scene import Scene
from tests.pipeline.renders.guided_scenes import lit_by_a_mirror, mirrors
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.scene_kit import sampled_like_scene

pytestmark = pytest.mark.usefixtures("llvm")

PX = 32


def _sums(tracer: Tracer, scene: Scene, first_seed: int) -> list[NDArray]:
    """Return the sums of passes of other seeds, samples and pixels, some of them guided."""
    assert isinstance(tracer, VectorTracer)
    total, rng = tracer.pass_sum(camera_of(scene, PX)), np.random.default_rng(first_seed)
    for number, (spp, fraction) in enumerate(itertools.product((4, 16, 64), (1, 0.5, 0.1))):
        chosen = None if fraction == 1 else rng.random((PX, PX)) < fraction
        if number == 6:
            total.guide()
        total.add(seed=first_seed + number, spp=spp, chosen=chosen)
    return [read_back(sums) for sums in total.sums]


def test_replayed_passes_are_traced_ones_in_every_bit() -> None:
    """Whichever scene, camera, depth, seed and pixels a recording was made with."""
    scenes = [mirrors(), lit_by_a_mirror(0.1), sampled_like_scene(np.random.default_rng(3))]
    replayed, traced = [], []
    for repeat, scene in itertools.product(range(2), scenes):
        tracer = load_tracer(scene, max_depth=5 + repeat, rr_depth=2)
        replayed.append(_sums(tracer, scene, 100 * repeat))
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        for repeat, scene in itertools.product(range(2), scenes):
            tracer = load_tracer(scene, max_depth=5 + repeat, rr_depth=2)
            traced.append(_sums(tracer, scene, 100 * repeat))
    for ours, theirs in zip(replayed, traced, strict=True):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_scene_that_was_recorded_is_not_kept() -> None:
    scene = sampled_like_scene(np.random.default_rng(1))
    tracer = load_tracer(scene, max_depth=4, rr_depth=2)
    tracer.radiance(camera_of(scene, PX), seed=0, spp=4)
    table = weakref.ref(vars(vars(tracer)["_scene"])["table"])
    del tracer
    assert table() is None


def test_old_scenes_are_not_freed_while_a_call_is_recorded() -> None:
    """Dr.Jit would end the process."""
    old = load_tracer(mirrors(), max_depth=4, rr_depth=2)
    vars(old)["itself"] = old
    del old

    def double(_: Any, values: Any) -> Any:
        if gc.isenabled():
            gc.collect()
        return 2 * values

    doubled = record_launches(double)(KernelInputs(), dr.opaque(mi.Float, 1, 3))
    np.testing.assert_array_equal(doubled, 2)

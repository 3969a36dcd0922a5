"""Scene k is the same bytes wherever, whenever and beside whatever it is composed."""

import concurrent.futures
import multiprocessing
import os
from collections.abc import Sequence

import pytest

from pipeline.builds.named import named_build
from tests.pipeline.scenes.scene_facts import digest
from tests.pipeline.scenes.small_pool import first_scene, small_pool

SCENES = {
    "pretrain-256": tuple(range(8)),
    "renderformer-v1-512": tuple(range(8)),
    "out-of-range": (0, *range(5, 37, 4)),
}
"""Of the last, one with many triangles, and one of every other axis."""


def composed_digest(build: str, seed: int, index: int) -> str:
    """Compose one scene with the small pool; the work of one process."""
    settings = named_build(build).scenes
    return digest(first_scene(settings, small_pool(), seed=seed, scene_index=index))


def _digests(build: str, order: Sequence[int], seed: int = 0) -> dict[int, str]:
    return {index: composed_digest(build, seed, index) for index in order}


def _hold_to_one_processor() -> None:
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])


def _from_workers(workers: int) -> dict[str, dict[int, str]]:
    """Compose all scenes in so many new processes, the last scene first."""
    with concurrent.futures.ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_hold_to_one_processor if workers == 1 else None,
    ) as executor:
        jobs = {
            build: {
                index: executor.submit(composed_digest, build, 0, index)
                for index in reversed(indices)
            }
            for build, indices in SCENES.items()
        }
        return {
            build: {index: job.result() for index, job in found.items()}
            for build, found in jobs.items()
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
    # The comparison can fail: other scenes and other builds are other bytes.
    count = sum(len(indices) for indices in SCENES.values())
    assert len({sha for scenes in here.values() for sha in scenes.values()}) == count


def test_order_does_not_matter_and_seed_zero_is_a_seed() -> None:
    forward = _digests("pretrain-256", [0, 1, 2, 3, 4, 5])
    assert forward == _digests("pretrain-256", [5, 3, 1, 4, 2, 0])
    other = _digests("pretrain-256", [0, 1, 2, 3, 4, 5], seed=1)
    assert len({*forward.values(), *other.values()}) == 12


@pytest.mark.parametrize("build", SCENES)
def test_what_is_planned_does_not_depend_on_the_pool(build: str) -> None:
    """Which objects a scene holds may change with the pool, its kind may not."""
    settings = named_build(build).scenes
    pool = small_pool()
    for index in SCENES[build][1:5]:
        few, many = (
            first_scene(settings, entries, seed=0, scene_index=index)
            for entries in (pool[:4], pool)
        )
        for name in ("template", "family", "scene_index", "seed"):
            assert few.provenance[name] == many.provenance[name]
        kinds = [[entry.kind for entry in scene.objects] for scene in (few, many)]
        assert kinds[0] == kinds[1]

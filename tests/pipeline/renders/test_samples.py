"""Passes: the largest that lead to round numbers, in two halves that share nothing."""

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.samples import HalfSamples
from pipeline.renders.tracer import Chosen
from tests.oracle.host_sum import HostSum

CAMERA = Camera(c2w=np.eye(4), fov_deg=40.0, resolution=8)


class Recorder:
    """A tracer that writes down what it is asked, and whose light is the number of samples."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, int]] = []

    def pass_sum(self, camera: Camera) -> HostSum:
        return HostSum(self, camera)  # type: ignore[arg-type]

    def radiance(
        self, camera: Camera, *, seed: int, spp: int, chosen: Chosen = None
    ) -> NDArray[np.float32]:
        self.asked.append((spp, seed))
        picture = np.full((camera.resolution, camera.resolution, 3), spp, np.float32)
        return picture if chosen is None else picture * chosen[..., None]


def _passes(first_spp: int, spp: int, max_spp: int) -> tuple[HalfSamples, list[tuple[int, int]]]:
    tracer = Recorder()
    samples = HalfSamples([tracer], CAMERA, 0, first_spp=first_spp, max_spp=max_spp)  # type: ignore[list-item]
    for _ in samples.passes_to(spp):
        pass
    return samples, tracer.asked


def test_passes_are_the_largest_that_fit() -> None:
    for first_spp, spp, max_spp, of_a_half in (
        (128, 128, 512, [64]),
        (32, 32, 4096, [16]),
        (32, 256, 4096, [16, 16, 16, 16, 64]),
        (32, 160, 160, [16, 16, 16, 16, 16]),
        (8, 32, 64, [4, 4, 4, 4]),
        (8, 64, 64, [4, 4, 4, 4, 16]),
    ):
        samples, asked = _passes(first_spp, spp, max_spp)
        assert samples.spp == spp
        assert [size for size, _ in asked[::2]] == of_a_half
        assert [size for size, _ in asked[1::2]] == of_a_half


def test_the_mean_weighs_passes_by_their_samples() -> None:
    samples, _ = _passes(32, 256, 4096)
    expected = (4 * 16 * 16 + 64 * 64) / 128
    assert samples.mean().max() == samples.mean().min() == expected
    assert [float(half.mean()) for half in samples.half_means()] == [expected, expected]


def test_no_two_passes_have_the_same_seed() -> None:
    _, asked = _passes(32, 512, 4096)
    assert len({seed for _, seed in asked}) == len(asked)

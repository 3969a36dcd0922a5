"""`RememberingTracer`: traces nothing twice, and says what each answer took when it was traced.

The same view rendered to several noise floors is the same passes, more or fewer of them. With a
tracer that remembers, each target takes exactly the path that it would take alone, and is charged
for all that it uses, while the machine traces only what the hardest one needs.
"""

import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.tracer import Features, HostSum, Tracer

Answer = TypeVar("Answer")


class RememberingTracer:
    """A `Tracer` for one view, around another one; use a new one for every view."""

    def __init__(self, tracer: Tracer) -> None:
        self._tracer = tracer
        self._answers: dict[tuple[Any, ...], tuple[Any, float]] = {}
        self.owed_core_s = 0.0
        """Core-seconds of remembered answers since this was last set to 0: what the caller would
        have spent besides its own."""

    def only_light(self, row: int) -> "RememberingTracer":
        return RememberingTracer(self._tracer.only_light(row))

    def radiance(self, camera: Camera, *, seed: int, spp: int) -> NDArray[np.float32]:
        return self._remembered(
            ("radiance", seed, spp), lambda: self._tracer.radiance(camera, seed=seed, spp=spp)
        )

    def pass_sum(self, camera: Camera) -> HostSum:
        return HostSum(self, camera)

    def features(self, camera: Camera, *, seed: int, spp: int) -> Features:
        return self._remembered(
            ("features", seed, spp), lambda: self._tracer.features(camera, seed=seed, spp=spp)
        )

    def hits(self, camera: Camera) -> NDArray[np.bool_]:
        return self._remembered(("hits",), lambda: self._tracer.hits(camera))

    def _remembered(self, key: tuple[Any, ...], trace: Callable[[], Answer]) -> Answer:
        if key in self._answers:
            answer, core_s = self._answers[key]
            self.owed_core_s += core_s
        else:
            started = time.process_time()
            answer = trace()
            self._answers[key] = (answer, time.process_time() - started)
        return answer

"""Dr.Jit's memory: arrays that kernels gather from, what comes back, and launches traced once.

Functions with `record_launches` replay their launches. `dr.freeze` bakes in what a function finds
outside of its arguments, without a word, and keeps its arguments for good. So the objects that
kernels read come as `KernelInputs`: all of their arrays are inputs, all else that they hold tells
recordings apart, and no recording keeps a scene.
"""

import gc
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


def own_floats(values: NDArray) -> Any:
    """Return the values, flat, as a mi.Float in Dr.Jit's own aligned memory.

    Made from numpy, an array keeps numpy's memory, and Dr.Jit compiles another kernel for each way
    in which that happens to be aligned.
    """
    flat = np.ascontiguousarray(values, np.float32).ravel()
    copy = mi.Float(flat) * dr.opaque(mi.Float, 1)  # exact, and not simplified away
    dr.eval(copy)
    return copy


def own_integers(values: NDArray) -> Any:
    """Return whole numbers from 0 as a mi.UInt32, as `own_floats` does with floats."""
    copy = mi.UInt32(np.ascontiguousarray(values, np.uint32).ravel()) + dr.opaque(mi.UInt32, 0)
    dr.eval(copy)
    return copy


def opaque_vector(values: NDArray) -> Any:
    """Return three numbers as a mi.Vector3f that is no literal in a kernel."""
    return mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in values))


def read_back(values: Any) -> NDArray:
    """Return an array of Dr.Jit, or the components of a vector of arrays side by side, flat.

    This waits for all kernels that were launched before, so it is done where a number is needed,
    and never in between.
    """
    return np.array(dr.ravel(values))


_MOST_RECORDINGS = 64
"""Maximum number of recordings of a function; the oldest are dropped and recorded again."""


class KernelInputs:
    """Objects that kernels read in one call, and the key of its recording.

    Equal kinds of objects share recordings, whatever arrays hold. Floats of Python and arrays of
    numpy in them are left out: no kernel may read those.
    """

    def __init__(self, *objects: Any) -> None:
        """Collect the arrays of objects, of theirs, and so on."""
        self.objects = objects
        self.arrays: list[Any] = []
        self._kind = tuple(self._collect(objects))

    def _collect(self, value: Any) -> Iterator[Any]:
        yield type(value)
        if dr.is_array_v(value) or isinstance(value, mi.Object):
            self.arrays.append(value)
        elif isinstance(value, list | tuple):
            yield len(value)
            for item in value:
                yield from self._collect(item)
        elif type(value).__module__.startswith(f"{__package__}."):
            for name, item in vars(value).items():
                yield name
                yield from self._collect(item)
        elif not isinstance(value, np.ndarray | float):
            yield value

    def __hash__(self) -> int:
        return hash(self._kind)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, KernelInputs) and other._kind == self._kind


def record_launches(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that takes `KernelInputs` where `function` takes their objects, first.

    What differs from call to call comes in arrays. Numbers of Python among the arguments tell
    recordings apart, and so must all sizes: a replay reads that of a launch off the largest array
    of which each lane has one element, but other memory is as large as when it was recorded.
    """

    def call(inputs: KernelInputs, _: list[Any], *arguments: Any) -> Any:
        return function(*inputs.objects, *arguments)

    frozen = dr.freeze(call, limit=_MOST_RECORDINGS, warn_after=1 << 30)

    def replay(inputs: KernelInputs, *arguments: Any) -> Any:
        collects = gc.isenabled()
        gc.disable()  # to free an old scene cannot be recorded, and would end the process
        try:
            return frozen(inputs, inputs.arrays, *arguments)
        finally:
            if collects:
                gc.enable()
            inputs.objects = ()  # a recording keeps the inputs that it was made with
            inputs.arrays = []

    return replay

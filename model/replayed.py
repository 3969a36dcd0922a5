"""`Replayed`: a function of tensors that a GPU repeats as one recorded CUDA graph.

A view of `hits` is four thousand small kernels; submitting them one by one takes longer than they.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


class Replayed:
    """A function, which is run the first time, recorded the second, and repeated from then on.

    It may read nothing back and use no array of the host that its first run has not brought to the
    GPU. What it returns is overwritten by the next call.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]]) -> None:
        self._function = function
        self._calls = 0
        self._inputs: tuple[Tensor, ...] = ()
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the function's tensors, for tensors of always the same shapes on one GPU."""
        self._calls += 1
        if self._calls == 1:
            return self._function(*inputs)
        if self._graph is None:
            self._inputs = tuple(each.clone() for each in inputs)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                self._result = self._function(*self._inputs)
            self._graph = graph
        for held, new in zip(self._inputs, inputs, strict=True):
            held.copy_(new)
        self._graph.replay()
        return self._result


@contextmanager
def aside(device: torch.device | None) -> Iterator[Callable[[], None]]:
    """Let a graph that is being recorded do the block beside what follows it; else, in order.

    Arrays that the block reads have to live until the function that it yields was called, from
    which on its results may be read.
    """
    if device is None or device.type != "cuda" or not torch.cuda.is_current_stream_capturing():
        yield lambda: None
        return
    main = torch.cuda.current_stream(device)
    branch = torch.cuda.Stream(device)
    branch.wait_stream(main)
    with torch.cuda.stream(branch):
        yield lambda: main.wait_stream(branch)

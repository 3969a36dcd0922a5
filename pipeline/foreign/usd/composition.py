"""Bounds of the size of a stage: its prims are composed and counted before it is opened.

References, payloads, inherits and variants multiply prims without end, in more ways than a walk
over the arcs of single prims sees: a reference to `</A/B>` also brings the arcs of `</A>`, and a
class is inherited again wherever its heir is referenced. So no size is predicted here. USD's own
composition engine makes the prims, in the order of the tree, and is stopped as soon as there are
too many or they take too long. A composed prim holds at most 32,767 sites, which is USD's limit.
"""

import time
from collections.abc import Sequence
from typing import Any

from storage.errors import TrilightError

MAX_PRIMS = 500_000
"""Maximum number of composed prims; instances of one prototype count once."""
MAX_DEPTH = 150
"""Maximum nesting of prims."""
MAX_COMPOSITION_S = 20.0
"""Maximum CPU seconds for all prims: 500,000 of few arcs each take 4 to 10; chains of thousands of
references, or prims of thousands of sites, take hours."""


def composition_errors(root: Any, context: Any, name: str) -> Sequence[Any]:
    """Compose all prims below a root layer, payloads too, and return USD's errors.

    Args:
        root: the layer; every file it names must have been checked (pipeline.foreign.usd.stage).
        context: resolver context of the stage that will be opened.
        name: name of the file, for messages.

    Raises:
        TrilightError: too many prims, nested too deep, or not composed in time.
    """
    from pxr import Pcp, Sdf

    cache = Pcp.Cache(Pcp.LayerStackIdentifier(root, None, context), "usd", True)
    _, errors = cache.ComputeLayerStack(cache.GetLayerStackIdentifier())
    waiting = [Sdf.Path.absoluteRootPath]
    prototypes = set()
    num_prims = 0
    start_s = time.process_time()
    while waiting:
        path = waiting.pop()
        num_prims += 1
        _require_bounds(name, path, num_prims, time.process_time() - start_s)
        index, prim_errors = cache.ComputePrimIndex(path)
        if index.hasAnyPayloads:
            cache.RequestPayloads([path], [])
            index, prim_errors = cache.ComputePrimIndex(path)
        errors += prim_errors
        if index.IsInstanceable():
            prototype = Pcp.InstanceKey(index)
            if prototype in prototypes:
                continue
            prototypes.add(prototype)
        children, _ = index.ComputePrimChildNames()
        waiting += [path.AppendChild(child) for child in children]
    return errors


def _require_bounds(name: str, path: Any, num_prims: int, elapsed_s: float) -> None:
    if num_prims > MAX_PRIMS:
        raise TrilightError(f"{name}: composes more than {MAX_PRIMS} prims, the most that is read.")
    if path.pathElementCount > MAX_DEPTH:
        raise TrilightError(
            f"{name}: prims are nested more than {MAX_DEPTH} deep ({str(path)[:60]}...)."
        )
    if elapsed_s > MAX_COMPOSITION_S:
        raise TrilightError(
            f"{name}: {num_prims} prims took {elapsed_s:.0f} processor seconds to compose and more "
            f"follow; expected all within {MAX_COMPOSITION_S:.0f}. Flatten the stage."
        )

"""Light put into one of several sums as it is found: direct or indirect, diffuse or specular.

Which sums there are is decided when a kernel is traced, so that a kernel which keeps all light
together is the one that it would be without this file. A path has its samples whatever is asked:
the sums add up to the picture that is rendered without parts, but for roundings.
"""

from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders import ggx
from pipeline.renders.kernel_scene import Vertex
from storage.records.parts import part_names


class KernelParts:
    """The sums of a kernel. Not a dataclass: Dr.Jit would take it for variables of the loop."""

    def __init__(self, *, bounces: bool, lobes: bool) -> None:
        """Choose the sums, as `storage.records.parts.part_names`."""
        self._bounces = bounces
        self._lobes = lobes
        self.count = max(1, len(part_names(bounces=bounces, lobes=lobes)))
        """Number of sums."""
        self.num_lobes = 2 if lobes else 1
        """Number of sums of light that is indirect all of it."""

    def dark(self) -> list[Any]:
        """Return sums without light (Color3f)."""
        return [mi.Color3f(0) for _ in range(self.count)]

    def first_share(self) -> Any:
        """Return the value of `carry_share` for a path that has hit no surface."""
        return mi.Color3f(0) if self._lobes else None

    def share(self, vertex: Vertex, local: Any) -> Any:
        """Return the share (Color3f) of the diffuse lobe in the light that a vertex reflects.

        It is None where lobes are not apart.

        Args:
            vertex: as the camera path sees it.
            local: Vector3f, the direction from which the light comes, in the frame.
        """
        if not self._lobes:
            return None
        return ggx.diffuse_share(vertex.lobes, vertex.incoming, local, vertex.geometric)

    def carry_share(self, vertex: Vertex, local: Any, depth: Any, before: Any) -> Any:
        """Return the `share` of the first vertex of a path, which has `depth` (UInt32) by now."""
        if not self._lobes:
            return None
        return dr.select(depth == 1, self.share(vertex, local), before)

    def add(self, sums: list[Any], value: Any, depth: Any, share: Any) -> list[Any]:
        """Return the sums with light (Color3f) of paths of `depth` vertices on surfaces."""
        values = self.by_lobe(value, share)
        if self._bounces:
            direct = depth == 1
            values = [
                dr.select(direct == is_direct, part, 0)
                for part in values
                for is_direct in (True, False)
            ]
        return [total + part for total, part in zip(sums, values, strict=True)]

    def by_lobe(self, value: Any, share: Any) -> list[Any]:
        """Return light (Color3f) as one, or what the diffuse and the specular lobe have of it."""
        if not self._lobes:
            return [value]
        diffuse = value * share
        return [diffuse, value - diffuse]

    def of_indirect(self, values: list[Any]) -> list[Any]:
        """Return the sums of light which is indirect all of it, from those of `by_lobe`."""
        if not self._bounces:
            return values
        return [part for value in values for part in (mi.Color3f(0), value)]

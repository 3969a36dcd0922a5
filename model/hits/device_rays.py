"""Rays that a card traces: a tree of boxes, built by torch, and a kernel that walks through it.

The tree is complete: triangles are halved by their middles along the longest side of each box, as
often as leaves need. A node's halves are nodes 2n and 2n + 1. Whether a ray meets a triangle is
asked of the volumes that it spans with the edges, seen from the ray's start: two triangles of one
edge get the same number with opposite signs, so no ray slips between them.
"""

import functools
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.hits.device_arrays import DeviceArray, DevicePlace
from storage.records.surfaces import MISS

LEAF = 4
"""Triangles of a leaf."""

THREADS = 128

SOURCE = """
#define LEAF 4
#define FAR 3e38f

struct V { float x, y, z; };
__device__ inline V between(V a, V b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
__device__ inline V both(V a, V b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
__device__ inline float dot(V a, V b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
__device__ inline V cross(V a, V b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
__device__ inline float inverse(float a) {
    return 1 / (fabsf(a) < 1e-20f ? copysignf(1e-20f, a) : a);
}

/* Where a ray enters a box, or FAR where it passes. */
__device__ inline float enters(const float* box, V start, V inverted, float nearest) {
    float a = (box[0] - start.x) * inverted.x, b = (box[3] - start.x) * inverted.x;
    float first = fminf(a, b), last = fmaxf(a, b);
    a = (box[1] - start.y) * inverted.y; b = (box[4] - start.y) * inverted.y;
    first = fmaxf(first, fminf(a, b)); last = fminf(last, fmaxf(a, b));
    a = (box[2] - start.z) * inverted.z; b = (box[5] - start.z) * inverted.z;
    first = fmaxf(first, fminf(a, b)); last = fminf(last, fmaxf(a, b));
    first = fmaxf(first, 0.0f);
    return first <= fminf(last * 1.000001f, nearest) ? first : FAR;
}

/* Rays are [rays, 3], and uv is [2, rays]. With limits, a ray is asked only whether it meets
   nothing before its limit, which `is_free` says. */
extern "C" __global__ void trace(
    const float* starts, const float* directions, const float* limits,
    const float* boxes, const float* corners, const long long* rows,
    long long* triangle, float* uv, unsigned char* is_free, int rays, int leaves, int asks_free)
{
    int ray = blockIdx.x * blockDim.x + threadIdx.x;
    if (ray >= rays) return;
    V start = {starts[3 * ray], starts[3 * ray + 1], starts[3 * ray + 2]};
    V along = {directions[3 * ray], directions[3 * ray + 1], directions[3 * ray + 2]};
    V inverted = {inverse(along.x), inverse(along.y), inverse(along.z)};
    float nearest = asks_free ? limits[ray] : FAR, u = 0, v = 0;
    int met = -1, waiting[32], count = 0, node = 1;
    float entry[32];
    for (;;) {
        if (node < leaves) {
            float a = enters(boxes + 12 * node, start, inverted, nearest);
            float b = enters(boxes + 12 * node + 6, start, inverted, nearest);
            int nearer = 2 * node + (b < a), other = 2 * node + (b >= a);
            if (fmaxf(a, b) < FAR) { waiting[count] = other; entry[count++] = fmaxf(a, b); }
            if (fminf(a, b) < FAR) { node = nearer; continue; }
        } else {
            for (int k = 0; k < LEAF; k++) {
                int row = (node - leaves) * LEAF + k;
                const float* at = corners + 9 * row;
                V a = between({at[0], at[1], at[2]}, start);
                V b = between({at[3], at[4], at[5]}, start);
                V c = between({at[6], at[7], at[8]}, start);
                float of_b = dot(cross(between(c, a), both(c, a)), along);
                float of_c = dot(cross(between(a, b), both(a, b)), along);
                float of_a = dot(cross(between(b, c), both(b, c)), along);
                float all = of_a + of_b + of_c, rim = fabsf(all) * 1.1920929e-7f;
                float least = fminf(of_a, fminf(of_b, of_c));
                float most = fmaxf(of_a, fmaxf(of_b, of_c));
                if (all == 0 || (least < -rim && most > rim)) continue;
                V normal = cross(between(b, a), between(c, a));
                float far = dot(normal, a) / dot(normal, along);
                if (far > 0 && far <= nearest) {
                    nearest = far; met = row; u = of_b / all; v = of_c / all;
                    if (asks_free) { is_free[ray] = 0; return; }
                }
            }
        }
        do { if (!count) goto done; --count; } while (entry[count] > nearest);
        node = waiting[count];
    }
done:
    if (asks_free) { is_free[ray] = 1; return; }
    triangle[ray] = met < 0 ? -1 : rows[met];
    uv[ray] = u; uv[ray + rays] = v;
}
"""
"""CUDA: a thread for each ray."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tree:
    """T triangles in a complete tree of 2^d leaves, padded with the last one."""

    boxes: Tensor
    """[2 leaves, 6] least and greatest corner of each node's box; the first stands for nothing."""
    corners: Tensor
    """[LEAF leaves, 9] of the triangles, leaf by leaf."""
    rows: Tensor
    """[LEAF leaves] which triangle each is; int64."""

    @property
    def leaves(self) -> int:
        return len(self.boxes) // 2


def build_tree(corners_T33: Tensor, rows_T: Tensor) -> Tree:
    """Return the tree of triangles, where they are; without any, one that no ray meets."""
    if not len(rows_T):
        corners_T33, rows_T = corners_T33.new_zeros(1, 3, 3), rows_T.new_full((1,), MISS)
    count = len(rows_T)
    depth = max(-(-count // LEAF) - 1, 0).bit_length()
    order = torch.arange(LEAF << depth, device=rows_T.device).clamp(max=count - 1)
    middle_T3 = (corners_T33.amin(dim=1) + corners_T33.amax(dim=1)) / 2
    for level in range(depth):
        order = order.unflatten(0, (1 << level, -1))
        middles = middle_T3[order]
        longest = (middles.amax(dim=1) - middles.amin(dim=1)).argmax(dim=-1)
        along = middles.gather(2, longest[:, None, None].expand(-1, middles.shape[1], 1))
        order = order.gather(1, along[..., 0].argsort(dim=1, stable=True)).flatten()
    corners = corners_T33[order]
    least = corners.flatten(0, 1).unflatten(0, (-1, 3 * LEAF)).amin(dim=1)
    most = corners.flatten(0, 1).unflatten(0, (-1, 3 * LEAF)).amax(dim=1)
    levels = [torch.cat([least, most], dim=-1)]
    while len(least) > 1:
        least, most = (
            least.unflatten(0, (-1, 2)).amin(dim=1),
            most.unflatten(0, (-1, 2)).amax(dim=1),
        )
        levels.append(torch.cat([least, most], dim=-1))
    levels.append(torch.zeros_like(levels[-1]))
    return Tree(
        boxes=torch.cat(levels[::-1]).contiguous(),
        corners=corners.reshape(-1, 9).contiguous(),
        rows=rows_T[order].contiguous(),
    )


@functools.cache
def compiled_kernel(device: torch.device) -> Any | None:
    """Return the kernel for a card; None where it cannot be compiled, and rays stay on the CPU."""
    if device.type != "cuda":
        return None
    try:
        with torch.cuda.device(device):
            return torch.cuda._compile_kernel(SOURCE, "trace")
    except (AttributeError, OSError, RuntimeError) as error:
        warnings.warn(f"the card's rays stay with the processor: {error}", stacklevel=2)
        return None


@dataclass(frozen=True, kw_only=True, eq=False)
class MetOnDevice:
    """What N rays meet first."""

    triangle: DeviceArray
    """[N] row, or MISS; int64."""
    uv: DeviceArray
    """[2, N] weights of the second and third corner; 0 where nothing is met."""


class DeviceTriangles:
    """Some triangles of many, as rays on a card meet them (as storage.records.surfaces)."""

    def __init__(
        self, corners_T33: NDArray[np.float32], rows: NDArray[np.intp], place: DevicePlace
    ):
        """Take the corners of triangles, world space, and the rows of those that are there."""
        self._place = place
        corners = torch.tensor(corners_T33[rows], device=place.device)
        self._tree = build_tree(corners, torch.tensor(rows, device=place.device))

    def met(self, origins: DeviceArray, directions: DeviceArray) -> MetOnDevice:
        """Return what rays [N, 3] from `origins` [N, 3] meet first, from either side."""
        count = len(directions)
        triangle = self._tree.rows.new_empty(count)
        uv = self._tree.boxes.new_empty(2, count)
        self._launch(origins, directions, uv, triangle, uv, triangle, 0)
        return MetOnDevice(
            triangle=DeviceArray(triangle, self._place), uv=DeviceArray(uv, self._place)
        )

    def is_free(
        self, origins: DeviceArray, directions: DeviceArray, distances_m: DeviceArray
    ) -> DeviceArray:
        """Return [N] whether rays meet nothing up to a distance [N], in lengths of directions."""
        free = self._tree.rows.new_empty(len(directions), dtype=torch.bool)
        limits = distances_m.tensor.contiguous()
        self._launch(origins, directions, limits, self._tree.rows, limits, free, 1)
        return DeviceArray(free, self._place)

    def _launch(
        self,
        origins: DeviceArray,
        directions: DeviceArray,
        limits: Tensor,
        triangle: Tensor,
        uv: Tensor,
        free: Tensor,
        asks_free: int,
    ) -> None:
        tree, count = self._tree, len(directions)
        kernel = compiled_kernel(self._place.device)
        assert kernel is not None
        rays = [each.tensor.contiguous() for each in (origins, directions)]
        kernel(
            grid=(-(-count // THREADS), 1, 1),
            block=(THREADS, 1, 1),
            args=[
                *rays, limits, tree.boxes, tree.corners, tree.rows,
                triangle, uv, free, count, tree.leaves, asks_free,
            ],
        )  # fmt: skip

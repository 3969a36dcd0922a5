"""Ray tracing on a GPU: a tree of boxes (BVH) by torch, and a kernel that walks through it.

A node has four children: its triangles are halved twice, each time where the surface of the halves'
boxes, weighed by their triangles, is least (binned, Wald 2007). Whether a ray meets a triangle is
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

from model.hits.device_arrays import DeviceArray, DevicePlace
from storage.raycast import MISS, RayHits

LEAF = 4
"""Most triangles of a leaf; at most 7, as a leaf's number has three bits for them."""

BINS = 16
"""Places along each axis between which a cut may be."""

LEVELS = 10
"""Levels whose cuts are chosen; below them halves are even, so that rays' stacks end."""

THREADS = 128

SOURCE = """
#define FAR 3e38f
#define STACK 64

struct V { float x, y, z; };
struct alignas(16) Floats { float at[4]; };
struct alignas(16) Ints { int at[4]; };
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
__device__ inline float enters(V least, V most, V start, V inverted, float nearest) {
    float a = (least.x - start.x) * inverted.x, b = (most.x - start.x) * inverted.x;
    float first = fminf(a, b), last = fmaxf(a, b);
    a = (least.y - start.y) * inverted.y; b = (most.y - start.y) * inverted.y;
    first = fmaxf(first, fminf(a, b)); last = fminf(last, fmaxf(a, b));
    a = (least.z - start.z) * inverted.z; b = (most.z - start.z) * inverted.z;
    first = fmaxf(first, fminf(a, b)); last = fminf(last, fmaxf(a, b));
    first = fmaxf(first, 0.0f);
    return first <= fminf(last * 1.000001f, nearest) ? first : FAR;
}

/* Rays are [rays, 3], and uv is [2, rays]. With limits, a ray is asked only whether it meets
   nothing before its limit, which `is_free` says. */
extern "C" __global__ void trace(
    const float* __restrict__ starts, const float* __restrict__ directions,
    const float* __restrict__ limits, const Floats* __restrict__ nodes,
    const Floats* __restrict__ corners, const long long* __restrict__ rows,
    long long* triangle, float* uv, unsigned char* is_free, int rays, int asks_free)
{
    int ray = blockIdx.x * blockDim.x + threadIdx.x;
    if (ray >= rays) return;
    V start = {starts[3 * ray], starts[3 * ray + 1], starts[3 * ray + 2]};
    V along = {directions[3 * ray], directions[3 * ray + 1], directions[3 * ray + 2]};
    V inverted = {inverse(along.x), inverse(along.y), inverse(along.z)};
    float nearest = asks_free ? limits[ray] : FAR, u = 0, v = 0;
    int met = -1, count = 0, child = 0, waiting[STACK];
    float entry[STACK];
    for (;;) {
        if (child >= 0) {
            const Floats* node = nodes + 8 * child;
            Floats box[6];
            #pragma unroll
            for (int k = 0; k < 6; k++) box[k] = node[k];
            Ints children = *(const Ints*)(node + 6);
            float least = FAR;
            #pragma unroll
            for (int k = 0; k < 4; k++) {
                float far = enters(
                    {box[0].at[k], box[1].at[k], box[2].at[k]},
                    {box[3].at[k], box[4].at[k], box[5].at[k]}, start, inverted, nearest);
                if (far >= FAR) continue;
                int other = children.at[k];
                if (far < least) {
                    int nearer = other; other = child; child = nearer;
                    float nearer_entry = far; far = least; least = nearer_entry;
                }
                if (far < FAR) { waiting[count] = other; entry[count++] = far; }
            }
            if (least < FAR) continue;
        } else {
            int first = ~child >> 3, last = first + (~child & 7);
            for (int row = first; row < last; row++) {
                Floats at[3];
                #pragma unroll
                for (int k = 0; k < 3; k++) at[k] = corners[3 * row + k];
                V a = between({at[0].at[0], at[0].at[1], at[0].at[2]}, start);
                V b = between({at[0].at[3], at[1].at[0], at[1].at[1]}, start);
                V c = between({at[1].at[2], at[1].at[3], at[2].at[0]}, start);
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
        child = waiting[count];
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
    """T triangles in a tree of N nodes, of which the first is its root."""

    nodes: NDArray[np.float32]
    """[N, 32] of four children each: the boxes' least x, y and z, their greatest, and as integers
    another node's row, or ~(8 first + count) of a leaf; then four unused."""
    corners: NDArray[np.float32]
    """[T, 12] of the triangles, leaf by leaf; three unused."""
    rows: NDArray[np.int64]
    """[T] row of each triangle in the scene."""


def build_tree(corners_T33: NDArray[np.float32], rows_T: NDArray[np.intp]) -> Tree:
    """Return the tree of triangles; without any, one that no ray meets."""
    if not len(rows_T):
        return build_tree(np.zeros((1, 3, 3), np.float32), np.array([MISS]))
    least = corners_T33.min(axis=1)
    most = corners_T33.max(axis=1)
    waiting = np.arange(len(rows_T))
    node = np.zeros(len(rows_T), np.int64)
    order: list[NDArray] = []
    levels: list[NDArray] = []
    num_nodes = num_placed = 0
    count = 1
    while count:
        boxes = least[waiting], most[waiting]
        for halving in (1, 2):
            is_even = len(levels) >= LEVELS
            node = 2 * node + goes_right(*boxes, node, halving * count, is_even=is_even)
        sizes = np.bincount(node, minlength=4 * count)
        is_leaf = sizes <= LEAF
        placed = np.where(is_leaf, sizes, 0)
        first = num_placed + placed.cumsum() - placed
        number = (~is_leaf).cumsum() - 1
        children = np.where(is_leaf, ~(8 * first + sizes), num_nodes + count + number)
        low, high = _boxes(*boxes, node, 4 * count)
        high[sizes == 0] = np.inf  # a point that no ray meets
        sides = np.concatenate([low, high], axis=1).reshape(count, 4, 6).swapaxes(1, 2)
        level = np.zeros((count, 8, 4), np.float32)
        level[:, :6] = sides
        level.view(np.int32)[:, 6] = children.reshape(count, 4)
        levels.append(level.reshape(count, 32))
        in_leaf = is_leaf[node]
        order.append(waiting[in_leaf][node[in_leaf].argsort(kind="stable")])
        waiting = waiting[~in_leaf]
        node = number[node[~in_leaf]]
        num_nodes += count
        num_placed += int(placed.sum())
        count = len(sizes) - int(is_leaf.sum())
    order_T = np.concatenate(order)
    corners = np.zeros((len(order_T), 12), np.float32)
    corners[:, :9] = corners_T33[order_T].reshape(-1, 9)
    return Tree(nodes=np.concatenate(levels), corners=corners, rows=rows_T[order_T])


def goes_right(
    least: NDArray, most: NDArray, group: NDArray, num_groups: int, *, is_even: bool
) -> NDArray[np.bool_]:
    """Return a mask [A] of the triangles in the second half of their group; of a leaf's, none.

    Args:
        least, most: [A, 3] corners of their boxes.
        group: [A] of `num_groups`.
        is_even: whether halves are to have as many triangles as each other.
    """
    size = np.bincount(group, minlength=num_groups)
    by_group = group.argsort(kind="stable")
    rank = np.empty_like(group)
    rank[by_group] = np.arange(len(group)) - (size.cumsum() - size)[group[by_group]]
    is_right = 2 * rank >= size[group]
    if not is_even:
        middle = (least + most) / 2
        first, last = (each[group] for each in _boxes(middle, middle, group, num_groups))
        share = (middle - first) / np.maximum(last - first, 1e-30)
        place_A3 = np.minimum((share * BINS).astype(np.int64), BINS - 1)
        cost_GC = _costs(least, most, group, place_A3, num_groups)
        axis, cut = np.divmod(cost_GC.argmin(axis=1), BINS - 1)
        is_beyond = place_A3[np.arange(len(group)), axis[group]] > cut[group]
        is_right = np.where(np.isfinite(cost_GC.min(axis=1))[group], is_beyond, is_right)
    return is_right & (size[group] > LEAF)


def _costs(
    least: NDArray, most: NDArray, group: NDArray, place_A3: NDArray, num_groups: int
) -> NDArray[np.float32]:
    """Return the cost of each cut of a group [groups, 3 axes x (BINS - 1)]; infinite: no cut."""
    cell = ((group[:, None] * 3 + np.arange(3)) * BINS + place_A3).ravel()
    shape = num_groups, 3, BINS
    count = np.bincount(cell, minlength=3 * BINS * num_groups).reshape(shape)
    boxes = _boxes(least.repeat(3, axis=0), most.repeat(3, axis=0), cell, count.size)
    low, high = (each.reshape(*shape, 3) for each in boxes)
    costs = []
    for along in (slice(None), slice(None, None, -1)):
        extent = np.maximum.accumulate(high[:, :, along], axis=2)
        extent = np.maximum(extent - np.minimum.accumulate(low[:, :, along], axis=2), 0)
        x, y, z = np.moveaxis(extent, -1, 0)
        number = count[:, :, along].cumsum(axis=2)
        cost = np.where(number > 0, (x * y + y * z + z * x) * number, np.inf)
        costs.append(cost[:, :, along])
    return (costs[0][..., :-1] + costs[1][..., 1:]).reshape(num_groups, -1)


def _boxes(
    least: NDArray, most: NDArray, group: NDArray, count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the boxes of groups, [count, 3] each; of an empty one, infinite and -infinite."""
    low = np.full((3, count), np.inf, np.float32)
    high = np.full((3, count), -np.inf, np.float32)
    for axis in range(3):
        np.minimum.at(low[axis], group, least[:, axis])
        np.maximum.at(high[axis], group, most[:, axis])
    return low.T.copy(), high.T.copy()


@functools.cache
def compiled_kernel(device: torch.device) -> Any | None:
    """Return the kernel for a GPU; None where it cannot be compiled, and rays stay on the CPU."""
    if device.type != "cuda":
        return None
    try:
        with torch.cuda.device(device):
            return torch.cuda._compile_kernel(SOURCE, "trace")
    except (AttributeError, OSError, RuntimeError) as error:
        warnings.warn(f"the GPU cannot trace rays, so the CPU does: {error}", stacklevel=2)
        return None


class DeviceTriangles:
    """Some triangles of many, as rays on a GPU meet them: a `RayCaster` of `DeviceArray`s."""

    def __init__(
        self, corners_T33: NDArray[np.float32], rows: NDArray[np.intp], place: DevicePlace
    ):
        """Take the corners of triangles, world space, and the rows of those that are there."""
        self._place = place
        tree = build_tree(corners_T33[rows], rows)
        self._tree = [place.array(each).tensor for each in vars(tree).values()]

    def intersect(self, origins: DeviceArray, directions: DeviceArray) -> RayHits:
        """Return the first hits of rays [N, 3] from `origins` [N, 3], from either side."""
        triangle, uv, _ = self._trace(origins, directions, None)
        return RayHits(triangle=triangle, uv=uv)

    def is_free(
        self, origins: DeviceArray, directions: DeviceArray, distances_m: DeviceArray
    ) -> DeviceArray:
        """Return [N] whether rays meet nothing up to a distance [N], in lengths of directions."""
        return self._trace(origins, directions, distances_m)[2]

    def _trace(
        self, origins: DeviceArray, directions: DeviceArray, limits: DeviceArray | None
    ) -> tuple[DeviceArray, ...]:
        """Return triangle and uv of each ray's hit; or, in third place, what limits leave free."""
        count = len(directions)
        device = self._place.device
        triangle = torch.empty(count, dtype=torch.long, device=device)
        uv = torch.empty(2, count, device=device)
        free = torch.empty(count, dtype=torch.bool, device=device)
        kernel = compiled_kernel(device)
        assert kernel is not None
        rays = [each.tensor.contiguous() for each in (origins, directions)]
        rays.append(uv if limits is None else limits.tensor.contiguous())
        kernel(
            grid=(-(-count // THREADS), 1, 1),
            block=(THREADS, 1, 1),
            args=[*rays, *self._tree, triangle, uv, free, count, int(limits is not None)],
        )
        return tuple(DeviceArray(each, self._place) for each in (triangle, uv, free))

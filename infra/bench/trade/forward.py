"""Forward passes of a network with random weights, as bright as rendered pictures, on a processor.

A graphics card is measured by `trilight bench model`: here every cost is one of core-seconds.
"""

import torch

from infra.bench.model.cases import timed_forward
from infra.bench.model.contenders import Forward, bright_network
from infra.bench.model.workloads import scene_of
from infra.bench.trade.workshop import Effort
from model.config import SIZES
from model.costs import Workload
from model.renderformer import RenderFormer
from model.scene_tensors import batch_scenes

SHARES = (0.1, 1 / 3, 2 / 3, 1.0, 5 / 3, 8 / 3)
"""Of the effort's triangles: sizes at which the time of the network is measured; 154 to 4096."""
CPU = torch.device("cpu")


def workload_of(effort: Effort, triangles: int | None = None) -> Workload:
    """Return the effort's scene and view, or one of other triangles."""
    return Workload(
        triangles=effort.network_triangles if triangles is None else triangles,
        views=1,
        resolution=effort.network_px,
    )


def forward_of(model: RenderFormer, workload: Workload) -> Forward:
    """Return a pass over a prepared scene: encoded, then decoded for its one view."""
    batch = batch_scenes([scene_of(workload)])
    return lambda: model.decode(model.encode(batch), batch.cameras, workload.resolution)[0]


def core_s_by_triangles(effort: Effort) -> dict[int, float]:
    """Return core-seconds of one pass by triangles; the smallest runs twice, to warm up."""
    model = bright_network(SIZES[effort.network]())
    sizes = [max(16, round(share * effort.network_triangles)) for share in SHARES]
    timed_forward(forward_of(model, workload_of(effort, sizes[0])), CPU)
    found = {}
    for size in sizes:
        _, figures = timed_forward(forward_of(model, workload_of(effort, size)), CPU)
        found[size] = figures["core_s"]
    return found

"""`trilight model`: prints the size and cost of a network, or exports it."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from infra.cli.console import first_words, print_json, print_rows
from infra.cli.options import command
from infra.torch_library import require_torch
from storage.errors import TrilightError, expected_one_of
from storage.settings.described import checked
from storage.settings.ranges import Within

if TYPE_CHECKING:
    from model.costs import Costs, Workload


@checked()
class ModelOptions:
    """Network and workload."""

    network: str
    """Model size (smoke, tiny, small, base, large) or checkpoint."""
    triangles: Annotated[int, Within(1, 2**31 - 1, unit="triangles")] = 1536
    """Number of triangles of the scene whose cost is computed."""
    resolution: Annotated[int, Within(8, 8192, unit="pixels")] = 256
    """Width of a view in pixels."""
    views: Annotated[int, Within(1, 100_000, unit="views")] = 1
    """Number of views of the scene whose cost is computed."""


@checked()
class PublishOptions:
    """Export."""

    publish: Path | None = None
    """Folder for an export of the checkpoint with RenderFormer's names; by default none."""


@command("network")
def model(options: ModelOptions, files: PublishOptions) -> None:
    name = options.network
    first_words(f"Looking at {name}")
    require_torch("model")
    from model.config import SIZES
    from model.costs import Workload, costs

    network = None
    if name not in SIZES:
        from model.open import open_network

        try:
            network = open_network(name)
        except TrilightError as error:
            if Path(name).exists() or "/" in name:
                raise
            expected = expected_one_of(name, SIZES)
            raise TrilightError(
                f"model {name!r}: neither a size nor a checkpoint here; {expected}."
            ) from error
    config = network.config if network else SIZES[name]()
    if options.resolution % config.picture_px:
        raise TrilightError(
            f"--resolution is {options.resolution}; expected a multiple of {config.picture_px}, as "
            "this network's ray bundles and windows need."
        )
    workload = Workload(
        triangles=options.triangles, views=options.views, resolution=options.resolution
    )
    network_costs = costs(config, workload)
    if files.publish:
        if network is None:
            raise TrilightError(
                f"model: --publish needs a checkpoint; {name} is a size without weights."
            )
        from model.open import save_published

        save_published(network, files.publish)
    records = {"config": dataclasses.asdict(config), "workload": dataclasses.asdict(workload)}
    print_json({"name": name, **records, **dataclasses.asdict(network_costs)})
    _report(name, workload, network_costs)


def _report(name: str, workload: "Workload", counted: "Costs") -> None:
    total = sum(counted.parameters.values())
    flops = sum(counted.flops.values())
    rows = [("parameters", f"{total / 1e6:.2f} M")]
    rows += [(f"  {part}", f"{count / 1e6:.2f} M") for part, count in counted.parameters.items()]
    rows += [("work", f"{flops / 1e9:.1f} GFLOP")]
    for part, count in counted.flops.items():
        rows.append((f"  {part}", f"{count / 1e9:.1f} GFLOP, {count / flops:.0%}"))
    for precision, size in counted.weight_bytes.items():
        scene_mb = counted.scene_bytes[precision] / 1e6
        text = f"weights {size / 1e6:.0f} MB, encoded scene {scene_mb:.0f} MB"
        rows.append((f"memory, {precision}", text))
    parts = "float32 weights, gradients, AdamW; without activations"
    rows.append(("memory, training", f"{counted.training_bytes / 1e6:.0f} MB: {parts}"))
    views = f"{workload.views} view{'s' if workload.views > 1 else ''}"
    print_rows(
        f"{name}: {workload.triangles} triangles, {views} of {workload.resolution} pixels", rows
    )

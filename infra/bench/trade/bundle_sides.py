"""The view stage of one scene, with all ray bundles and with those that see geometry."""

import time
from dataclasses import dataclass

from torch import Tensor

from infra.bench.model.network_errors import log10_psnr_db
from model.empty_bundles import bundles_that_see
from model.renderformer import RenderFormer
from model.scene_tensors import batch_scenes, scene_tensors
from storage.scene import Scene


@dataclass(frozen=True, kw_only=True)
class BundleFigures:
    """One scene and view."""

    whole_core_s: float
    """Core-seconds with all bundles."""
    skipping_core_s: float
    """Without the empty ones."""
    share_empty: float
    """Of the bundles."""
    psnr_log_db: float
    """Of the picture without them to the one with them."""


def bundle_figures(model: RenderFormer, scene: Scene, resolution: int) -> BundleFigures:
    """Return the figures of a scene's first view; the scene is encoded once, not counted.

    After a pass that is not counted the two take turns, and the lower of two times counts: other
    work only adds to it.
    """
    batch = batch_scenes([scene_tensors(scene)])
    encoded, cameras = model.encode(batch), batch.cameras
    sees = bundles_that_see(encoded.places, cameras, resolution, model.config.patch_px)
    model.decode(encoded, cameras, resolution)
    pictures: dict[bool, Tensor] = {}
    spent: dict[bool, list[float]] = {False: [], True: []}
    for skip in (False, True, True, False):
        started = time.process_time()
        pictures[skip] = model.decode(encoded, cameras, resolution, skip_empty_bundles=skip)
        spent[skip].append(time.process_time() - started)
    return BundleFigures(
        whole_core_s=min(spent[False]),
        skipping_core_s=min(spent[True]),
        share_empty=1 - float(sees.double().mean()),
        psnr_log_db=log10_psnr_db(pictures[True], pictures[False]),
    )

"""The view stage of one scene, with all ray bundles and with those that see geometry."""

import time
from dataclasses import dataclass

from infra.bench.trade.network_errors import log10_psnr_db
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
    """Return the figures of a scene's first view; the scene is encoded once, not counted."""
    batch = batch_scenes([scene_tensors(scene)])
    encoded, cameras = model.encode(batch), batch.cameras
    sees = bundles_that_see(encoded.places, cameras, resolution, model.config.patch_px)
    marks, pictures = [time.process_time()], []
    for skip in (False, True):
        pictures.append(model.decode(encoded, cameras, resolution, skip_empty_bundles=skip))
        marks.append(time.process_time())
    whole, skipping = pictures
    return BundleFigures(
        whole_core_s=marks[1] - marks[0],
        skipping_core_s=marks[2] - marks[1],
        share_empty=1 - float(sees.double().mean()),
        psnr_log_db=log10_psnr_db(skipping, whole),
    )

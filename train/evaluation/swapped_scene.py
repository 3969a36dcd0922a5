"""The same network shown the triangles of another scene: does it look at the scene at all?

One that has only learned what pictures look like on average loses nothing by it.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.renderformer import RenderFormer
from model.scene_tensors import SceneTensors
from train.data.scenes import TrainingScene
from train.evaluation.judge import predict
from train.evaluation.judged_view import NETWORK, JudgedView


def swapped_pictures(
    network: RenderFormer, scene: TrainingScene, other: SceneTensors
) -> NDArray[np.float64]:
    """Return another scene through the cameras of this one, linear radiance [V, R, R, 3]."""
    cameras = scene.tensors
    seen = dataclasses.replace(other, c2w_V44=cameras.c2w_V44, fov_deg_V=cameras.fov_deg_V)
    return predict(network, dataclasses.replace(scene, tensors=seen))


def loss_by_swapping(views: Sequence[JudgedView]) -> dict[str, Any] | None:
    """Return how much psnr_log_db is lost, view by view; None where there is but one scene."""
    losses_db = [
        own_db - view.swapped_psnr_log_db
        for view in views
        if view.swapped_psnr_log_db is not None
        and (own_db := view.scores[NETWORK]["psnr_log_db"]) is not None
    ]
    if not losses_db:
        return None
    return {
        "views": len(losses_db),
        "median_db": float(np.median(losses_db)),
        "mean_db": float(np.mean(losses_db)),
        "share_lost": float(np.mean(np.array(losses_db) > 0)),
    }

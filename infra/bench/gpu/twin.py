"""Pictures by the built-in networks on a GPU, compared with stored ones of a processor.

The comparison finds a GPU with wrong results before any time is trusted. The stored pictures belong
to certain weights, named by their digest: after another training of a built-in network, `python -m
infra.bench.gpu.twin` renders them again.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from infra.bench.gpu.steps import time_calls
from infra.bench.workloads.cost_scene import cost_scene
from model.inference import NeuralRenderer
from model.open import BUILTIN_NETWORKS
from storage.conventions import log10_radiance, radiance_from_log10
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.installation import module_name
from storage.metrics import psnr_log_db

NETWORKS = ("builtin:tokens", "builtin:hits")
STORED = Path(__file__).with_name("twin.npz")
"""float16 log10(1 + radiance) [64, 64, 3] by network, and the digest of its weights."""
TRIANGLES = 400
LIGHTS = 4
PX = 64
MORE_VIEWS = 5


def twin_figures(network: str, precision: str, device: torch.device) -> dict[str, float]:
    """Return psnr_log_db of a network's picture to the stored one, and milliseconds of a view.

    Raises:
        TrilightError: the stored picture belongs to other weights than the built-in network's.
    """
    twin = stored_twin(network)
    picture, seconds = _render(network, device, precision)
    return {"ms": 1e3 * seconds, "db": psnr_log_db(picture, twin)}


def stored_twin(network: str) -> NDArray[np.float64]:
    """Return the stored picture [64, 64, 3] of a network, linear radiance.

    Raises:
        TrilightError: the picture belongs to other weights.
    """
    with np.load(STORED, allow_pickle=False) as stored:
        digest = str(stored[f"{network} sha256"])
        picture = stored[network]
    if digest != (now := _digest(network)):
        raise TrilightError(
            f"bench gpu: the stored picture of {network} is by weights of sha256 {digest[:8]}, "
            f"and {now[:8]} is what this Trilight has; make it again: python -m "
            f"{module_name('infra.bench.gpu.twin')}."
        )
    return radiance_from_log10(picture.astype(np.float64))


def _digest(network: str) -> str:
    return sha256_hex(BUILTIN_NETWORKS[network].read_bytes())


def _render(
    network: str, device: torch.device, precision: str
) -> tuple[NDArray[np.float64], float]:
    """Return the first view of the scene, and the seconds of one more after the warm-up."""
    renderer = NeuralRenderer.load(network, device=str(device), precision=precision)
    scene = cost_scene(TRIANGLES, LIGHTS)
    prepared = renderer.prepare(scene)
    pose = scene.c2w[0]
    fov = float(scene.fov_deg[0])
    picture = renderer.view(prepared, pose, fov, PX)
    times = time_calls(
        lambda: renderer.view(prepared, pose, fov, PX), device, MORE_VIEWS, warm_up=0
    )
    return np.asarray(picture, np.float64), float(np.median(times))


def store(path: Path = STORED) -> None:
    """Render the scene by each network on the processor, and write the pictures."""
    stored_values: dict[str, Any] = {}
    for network in NETWORKS:
        picture, _ = _render(network, torch.device("cpu"), "float32")
        stored_values[network] = log10_radiance(picture).astype(np.float16)
        stored_values[f"{network} sha256"] = _digest(network)
    np.savez_compressed(path, **stored_values)


if __name__ == "__main__":
    store()

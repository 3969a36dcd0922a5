"""Where LPIPS' published weights come from: a folder, or their publishers' servers.

Trilight does not ship them: VGG16 is 528 MB. Both files are read with `weights_only`, so that
nothing in them can run.
"""

import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from storage.errors import TrilightError
from train.loss.lpips import Lpips

VGG16_FILE = "vgg16-397923af.pth"
"""torchvision's file of VGG16; the name holds the beginning of its sha256."""

LINEAR_FILE = "vgg.pth"
"""The linear weights of LPIPS 0.1 on VGG16 (6 KB)."""

VGG16_URL = f"https://download.pytorch.org/models/{VGG16_FILE}"
LINEAR_URL = (
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/"
    f"{LINEAR_FILE}"
)

HUB = "hub"
"""What to say in place of a folder to download them into torch's cache."""

VARIABLE = "TRILIGHT_LPIPS"
"""Environment variable with the folder, for those who name it once."""


def load_lpips(place: str | None) -> Lpips | None:
    """Return LPIPS with its published weights, or None where no place is named at all.

    Args:
        place: a folder with VGG16_FILE and LINEAR_FILE, or `hub`; None asks TRILIGHT_LPIPS.

    Raises:
        TrilightError: a file is missing, is no state dict, or cannot be downloaded.
    """
    place = place or os.environ.get(VARIABLE) or None
    if place is None:
        return None
    if place == HUB:
        return Lpips(_downloaded(VGG16_URL, check_hash=True), _downloaded(LINEAR_URL))
    return Lpips(_read(Path(place) / VGG16_FILE), _read(Path(place) / LINEAR_FILE))


def _read(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise TrilightError(
            f"LPIPS: {path} does not exist; expected {VGG16_FILE} (torchvision) and {LINEAR_FILE} "
            f"(LPIPS 0.1) in that folder, or `{HUB}` in its place to download them."
        )
    try:
        state: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever the damage leads to
        raise TrilightError(f"LPIPS: {path} is not readable ({type(error).__name__}).") from error
    return _checked(state, str(path))


def _downloaded(url: str, *, check_hash: bool = False) -> dict[str, Tensor]:
    try:
        state = torch.hub.load_state_dict_from_url(
            url, map_location="cpu", weights_only=True, check_hash=check_hash, progress=False
        )
    except Exception as error:  # no network, a proxy's page, a wrong hash: torch has no one class
        raise TrilightError(
            f"LPIPS: {url} could not be downloaded ({error}); name a folder that holds "
            f"{VGG16_FILE} and {LINEAR_FILE} instead."
        ) from error
    return _checked(state, url)


def _checked(state: Any, where: str) -> dict[str, Tensor]:
    if not isinstance(state, dict) or not all(isinstance(t, Tensor) for t in state.values()):
        raise TrilightError(f"LPIPS: {where} holds no state dict; expected tensors by name.")
    return state

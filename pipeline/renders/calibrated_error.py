"""Statement of an error that is calibrated on layouts of known truth."""

from importlib import metadata

from pipeline.renders.denoise_corrections import (
    DARKER,
    GLINT,
    LEAST_PASSES,
    MOST_APART,
    STANDARD_ERRORS,
    STANDS_OUT,
)
from pipeline.renders.noise_floor import BLOCK_PX
from pipeline.renders.settings import PASS_SPP
from pipeline.renders.tiles import TILE_PX
from storage.digests import canonical_json, sha256_hex

_CODE = 1
"""Number to raise where pictures or measures change without a change of a constant below."""


def versions_of_pictures() -> dict[str, str]:
    """Return what pictures and their measures depend on: the denoiser, and the renderer's revision.

    The revision is a digest of the constants by which samples, corrections and measures are made.
    """
    constants = [_CODE, PASS_SPP, TILE_PX, BLOCK_PX, LEAST_PASSES, STANDARD_ERRORS, STANDS_OUT,
                 DARKER, GLINT, MOST_APART]  # fmt: skip
    return {
        "denoiser": metadata.version("pyoidn"),
        "renderer": sha256_hex(canonical_json(constants))[:12],
    }

"""Settings of a picture whose number of samples is given, in place of its noise floor."""

from pipeline.renders.settings import RenderSettings
from storage.metrics import MAX_DB


def fixed_samples(resolution: int, spp: int) -> RenderSettings:
    """Return settings that no noise floor stops early.

    Args:
        resolution: pixels each way.
        spp: samples per pixel; a multiple of 128 for the best sampling.
    """
    return RenderSettings(
        resolution=resolution,
        noise_floor_db=MAX_DB - 1,
        min_spp=spp,
        max_spp=spp,
        min_mean_radiance=0.0,
    )

"""The kernel's BRDF by itself, for one material in all lanes. Needs an LLVM variant."""

from typing import Any

import numpy as np

from pipeline.renders import ggx
from pipeline.renders.ggx import AlbedoLookup, KernelLobes
from storage.records.lobes import lobes_of
from storage.records.multiscatter import scattered_again
from tests.pipeline.renders.scene_kit import material

UP = (0.0, 0.0, 1.0)


def kernel_lobes(*, diffuse: Any = 0.0, specular: Any = 0.0, roughness: float) -> KernelLobes:
    """Return one material as the kernel has it."""
    import mitsuba as mi

    row = material(diffuse=diffuse, specular=specular, roughness=roughness)
    lobes = lobes_of(row[None].astype(np.float32))
    again = scattered_again(lobes.specular, lobes.alpha, "correlated")
    return KernelLobes(
        diffuse=mi.Color3f(*lobes.diffuse[0].tolist()),
        specular=mi.Color3f(*lobes.specular[0].tolist()),
        alpha=mi.Float(lobes.alpha[0]),
        weight=mi.Float(lobes.weight[0]),
        again=mi.Color3f(*again[0].tolist()),
    )


def seen_at(lobes: KernelLobes, wi: Any) -> KernelLobes:
    """Return the lobes as a path vertex has them."""
    import mitsuba as mi

    return ggx.seen_from(lobes, wi, AlbedoLookup()(wi.z, lobes.alpha, mi.Bool(True)))


def direction(cosine: float) -> Any:
    import mitsuba as mi

    return mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0.0, cosine)

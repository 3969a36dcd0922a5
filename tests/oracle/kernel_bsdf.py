"""The kernel's BRDF as a Mitsuba plugin: with it, Mitsuba's own `path` integrator must make the
same pictures as our kernel, up to noise, whatever the material.

`PluginTracer` itself cannot serve for that: its `roughconductor` has another Smith term.
"""

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

from pipeline.renders import ggx
from pipeline.renders.ggx import AlbedoLookup, KernelLobes
from storage.records.scene import Scene
from tests.oracle import plugin_scene
from tests.oracle.plugin_tracer import PluginTracer

_PLUGIN = "kernel_bsdf"
_COLOURS, _NUMBERS = ("diffuse", "specular", "again"), ("alpha", "weight")


def exact_twin(scene: Scene, monkeypatch: pytest.MonkeyPatch, **depths: int) -> PluginTracer:
    """Return Mitsuba's integrator, emitters and geometry around the kernel's BRDF (LLVM only)."""
    _register()
    monkeypatch.setattr(plugin_scene, "_blend", lambda textures: {"type": _PLUGIN, **textures})
    monkeypatch.setattr(plugin_scene, "_two_sided", mi.load_dict)
    monkeypatch.setattr(plugin_scene, "_SMITH", "correlated")
    return PluginTracer(scene, **depths)


@cache
def _register() -> None:
    class KernelBsdf(mi.BSDF):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            names = (*_COLOURS, *_NUMBERS)
            self._textures = {name: properties.get_texture(name) for name in names}
            self._lookup = AlbedoLookup()
            sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [mi.BSDFFlags.GlossyReflection | sides]
            self.m_flags = self.m_components[0]

        def sample(self, ctx: Any, si: Any, u: Any, u2: Any, active: Any = True) -> Any:
            lobes, wi, geometric, side = self._seen(si, active)
            wo = ggx.sample(lobes, wi, u, u2)
            reflected, pdf = ggx.evaluate_bsdf(lobes, wi, wo, geometric)
            drawn: Any = mi.BSDFSample3f(_mirrored(wo, side))
            drawn.pdf, drawn.eta = pdf, 1.0
            drawn.sampled_type = +mi.BSDFFlags.GlossyReflection
            drawn.sampled_component = 0
            return drawn, dr.select(pdf > 0, reflected / pdf, 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            lobes, wi, geometric, side = self._seen(si, active)
            return ggx.evaluate_bsdf(lobes, wi, _mirrored(wo, side), geometric)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def _seen(self, si: Any, active: Any) -> tuple[KernelLobes, Any, Any, Any]:
            colours = {name: self._textures[name].eval(si, active) for name in _COLOURS}
            numbers = {name: self._textures[name].eval_1(si, active) for name in _NUMBERS}
            weight = numbers["weight"]
            lobes = KernelLobes(
                diffuse=colours["diffuse"] * (1 - weight),
                specular=colours["specular"] * weight,
                multiscatter=colours["again"],
                **numbers,
            )
            geometric = si.to_local(si.n)
            geometric = dr.mulsign(geometric, geometric.z)
            side = dr.sign(dr.dot(geometric, si.wi))
            wi = _mirrored(si.wi, side)
            albedo = self._lookup(wi.z, lobes.alpha, active)
            return ggx.seen_from(lobes, wi, albedo), wi, _mirrored(geometric, side) * side, side

    mi.register_bsdf(_PLUGIN, KernelBsdf)


def _mirrored(direction: Any, side: Any) -> Any:
    return mi.Vector3f(direction.x, direction.y, direction.z * side)

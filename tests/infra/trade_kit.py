"""A trade benchmark of seconds."""

from infra.bench.trade.workshop import Effort

TINY = Effort(
    scenes=2,
    resolution=32,
    max_spp=128,
    fixed_spp=64,
    picture_px=32,
    widths=(8, 16, 32, 64),
    objects=2,
    samples=1,
    composed=10,
    network="smoke",
    network_triangles=64,
    network_px=32,
    repeats=1,
)

"""Procedural environment maps (skies), by name of their family; extensions may add to them.

A family is a function of the draws of one sky and its texels; it returns the radiance [H, 2H, 3] up
to a factor, which `draw_sky` chooses. All that it draws has a name and a stated range, and its
noises take streams of their own, so that the same seed gives the same sky at every size.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scene_templates.exact import Numbers, dot, lerp, smoothstep
from scene_templates.skies.draws import SkyDraws, planckian_rgb
from scene_templates.skies.texels import SkyTexels
from storage.registry import Registry

LOW_SUN_MIRED = 420.0
HIGH_SUN_MIRED = 172.0
"""2,400 K on the horizon and 5,800 K above: the light of a low sun has crossed more air."""


def sun_and_sky(draws: SkyDraws, texels: SkyTexels) -> Numbers:
    """A clear or hazy sky, bluest above and bright at the horizon, with a sun and its glow.

    The sun is a spot of a few texels at most. Its irradiance on a plane that faces it is the stated
    multiple of what the rest of the upper half sends onto a horizontal plane, wherever a texel of
    it is above the horizon.
    """
    towards = draws.direction("sun", *draws.sun_elevation_deg)
    ratio = draws.uniform("irradiance of the sun over that of the sky", *draws.sun_to_sky)
    zenith = draws.blue("zenith")
    horizon = draws.light("horizon", mired=(120, 170))
    brightening = draws.uniform("horizon over zenith", 1.5, 5.0)
    haze = draws.uniform("share of the glow around the sun", 0.02, 0.3)
    sharpness = draws.uniform("sharpness of the glow", 4.0, 60.0)
    sun = planckian_rgb(_sun_mired(float(towards[2])))
    low = 1 - np.clip(texels.z, 0, 1)
    near = low * low * low
    sky = lerp(zenith, brightening * horizon, near[..., None]) + np.zeros((1, 2 * texels.height, 1))
    glow = texels.lobe(towards, sharpness)[..., None] * sun
    sky = sky * (1 - haze) + glow * (haze * _mean(texels.flux(sky)))
    from_sky = _mean(texels.irradiance(_above(sky, texels)))
    disk = _spot_above(texels, towards)[..., None] * sun * (ratio * from_sky)
    return _with_ground(draws, texels, sky + disk)


def _spot_above(texels: SkyTexels, towards: NDArray) -> Numbers:
    """Return a spot [H, 2H] whose part above the horizon has unit flux, or none if it has set."""
    spot = texels.spot(towards)
    seen = float(texels.flux(spot * _above_share(texels)))
    return spot / seen if seen > 0 else np.zeros_like(spot)


def _sun_mired(height: float) -> float:
    s = min(max(height, 0.0), 1.0)
    return LOW_SUN_MIRED + (HIGH_SUN_MIRED - LOW_SUN_MIRED) * s * (2 - s)


def clouds(draws: SkyDraws, texels: SkyTexels) -> Numbers:
    """Clouds of noise, from a few to all over, before a sky that darkens towards the horizon.

    Where all is covered, the mean follows the standard overcast sky of the CIE, which is three
    times as bright above as at the horizon.
    """
    cover = draws.uniform("level of the clouds", -0.6, 0.8)
    softness = draws.uniform("softness of their edges", 0.4, 1.4)
    cells = draws.uniform("cells of the clouds along a radius", 1.0, 2.5)
    shading = draws.uniform("darkening within the clouds", 0.2, 0.7)
    bright = draws.uniform("clouds over blue sky", 1.5, 5.0)
    cloud = draws.light("cloud", mired=(125, 180))
    blue = draws.blue("blue sky")
    towards = draws.direction("brightest place", 10, 80)
    shape = texels.noise(draws.stream(), cells, octaves=5)
    thickness = texels.noise(draws.stream(), 2 * cells, octaves=4)
    share = smoothstep(0.5 + (shape + cover) / softness)
    lit = 1 - shading * smoothstep(0.5 + thickness)
    overcast = (1 + 2 * np.clip(texels.z, 0, 1)) / 3
    sky = lerp(blue, bright * cloud * lit[..., None], share[..., None]) * overcast[..., None]
    glow = texels.lobe(towards, 3.0)[..., None] * np.pi
    return _with_ground(draws, texels, sky * (0.6 + glow))


def night(draws: SkyDraws, texels: SkyTexels) -> Numbers:
    """An almost dark sky, and one to six small warm lamps, each with its glow."""
    count = draws.whole("lamps", 1, 6)
    dark = draws.uniform("share of the sky", 0.005, 0.1)
    tint = draws.light("sky", mired=(40, 120))
    low = 1 - texels.z * texels.z
    sky = (0.3 + low * low)[..., None] * tint + np.zeros((1, 2 * texels.height, 1))
    lamps = np.zeros_like(sky)
    for _ in range(count):
        towards = draws.direction("lamp", -10, 60)
        power = draws.uniform("power of a lamp", 0.1, 1.0)
        colour = draws.light("lamp", mired=(220, 480))
        halo = draws.uniform("share of its glow", 0.02, 0.3)
        shape = lerp(texels.spot(towards), texels.lobe(towards, 200.0), halo)
        lamps = lamps + (power * shape)[..., None] * colour
    return shared_flux(texels, sky, lamps, dark)


def _with_ground(draws: SkyDraws, texels: SkyTexels, sky: Numbers) -> Numbers:
    """Return a sky above ground that reflects, as a Lambert surface, what the sky sends onto it."""
    albedo = draws.uniform("albedo of the ground", 0.05, 0.5)
    tint = draws.colour("tint of the ground", (0.75, 0.7, 0.5), (1.0, 1.0, 0.9))
    ground = albedo * tint * texels.irradiance(_above(sky, texels)) / np.pi
    return lerp(ground, sky, _above_share(texels)[..., None])


def _above(sky: Numbers, texels: SkyTexels) -> Numbers:
    result: Numbers = sky * _above_share(texels)[..., None]
    return result


def _above_share(texels: SkyTexels) -> Numbers:
    """[H, 1] how much of each row is above the horizon."""
    return np.clip(texels.height / 2 - np.arange(texels.height)[:, None], 0, 1)


def _mean(rgb: Numbers) -> float:
    return float((rgb[0] + rgb[1] + rgb[2]) / 3)


def shared_flux(texels: SkyTexels, one: Numbers, other: Numbers, share: float) -> Numbers:
    """Return the sum of two maps of which the first has `share` of the flux."""
    first = _mean(texels.flux(one))
    second = _mean(texels.flux(other))
    result: Numbers = one * (share / first) + other * ((1 - share) / second)
    return result


def constant(draws: SkyDraws, texels: SkyTexels) -> Numbers:
    """The same radiance from everywhere: a furnace."""
    colour = draws.light("light", mired=(60, 400))
    return np.ones((texels.height, 2 * texels.height, 1)) * colour


def gradient(draws: SkyDraws, texels: SkyTexels) -> Numbers:
    """From one colour to a darker one along a random axis."""
    towards = draws.direction("bright side", -90, 90)
    width = draws.uniform("half width of the change, in cosines", 0.2, 1.0)
    dark = draws.uniform("dark side over bright side", 0.0, 0.6)
    bright = draws.light("bright side", mired=(60, 400))
    other = draws.light("dark side", mired=(60, 400))
    share = smoothstep(0.5 + dot(texels.directions, towards) / (2 * width))
    return lerp(dark * other, bright, share[..., None])


def lobes(draws: SkyDraws, texels: SkyTexels) -> Numbers:
    """One to five round glows, from broad to narrow, before an even ground."""
    count = draws.whole("lobes", 1, 5)
    even = draws.uniform("share of the even light", 0.02, 0.4)
    ground = draws.light("even light", mired=(60, 400))
    glows = np.zeros((texels.height, 2 * texels.height, 3))
    for _ in range(count):
        towards = draws.direction("lobe", -90, 90)
        power = draws.uniform("power of a lobe", 0.1, 1.0)
        colour = draws.light("lobe", mired=(60, 450))
        # the square of a uniform number: narrow lobes are rarer than broad ones
        width = draws.uniform("root of the sharpness of a lobe", 1.0, 15.0)
        glows = glows + (power * texels.lobe(towards, width * width))[..., None] * colour
    return shared_flux(texels, np.ones_like(glows) * ground, glows, even)


def softboxes(draws: SkyDraws, texels: SkyTexels) -> Numbers:
    """A dim studio with one to five bright rectangles, turned anyhow, most of them above."""
    count = draws.whole("softboxes", 1, 5)
    even = draws.uniform("share of the studio", 0.02, 0.3)
    walls = draws.light("studio", mired=(120, 300))
    boxes = np.zeros((texels.height, 2 * texels.height, 3))
    for _ in range(count):
        towards = draws.direction("softbox", -20, 90)
        half = (
            draws.uniform("half width of a softbox", 0.1, 0.7),
            draws.uniform("half height of a softbox", 0.1, 0.7),
        )
        roll = draws.uniform("roll of a softbox, in radians", -np.pi / 2, np.pi / 2)
        power = draws.uniform("power of a softbox", 0.1, 1.0)
        colour = draws.light("softbox", mired=(120, 330))
        shape = texels.of_unit_flux(texels.pane(towards, half, roll_rad=roll), towards)
        boxes = boxes + (power * shape)[..., None] * colour
    studio = (0.6 + 0.4 * texels.z)[..., None] * np.ones_like(boxes) * walls
    return shared_flux(texels, studio, boxes, even)


def window_wall(draws: SkyDraws, texels: SkyTexels) -> Numbers:
    """A dim room with one wall of windows, divided by bars, and sky and ground behind them."""
    towards = draws.direction("middle of the windows", 0, 15)
    half = (
        draws.uniform("half width of the windows", 0.4, 1.6),
        draws.uniform("half height of the windows", 0.2, 0.7),
    )
    columns = draws.whole("columns of panes", 1, 6)
    rows = draws.whole("rows of panes", 1, 3)
    bars = draws.uniform("bars, in widths of a pane", 0.04, 0.25)
    inside = draws.uniform("share of the room", 0.05, 0.4)
    paint = draws.light("room", mired=(150, 350))
    sky = draws.light("sky", mired=(50, 170))
    ground = draws.uniform("ground over sky", 0.1, 0.6)
    panes = texels.of_unit_flux(
        texels.pane(towards, half, panes=(columns, rows), bars=bars), towards
    )
    outside = lerp(ground, 1.0, smoothstep(0.5 + 4 * texels.z))
    lit = 0.55 - 0.25 * dot(texels.directions, towards) - 0.2 * np.minimum(texels.z, 0)
    room = lit[..., None] * paint
    return shared_flux(texels, room, (panes * outside)[..., None] * sky, inside)


SkyFamily = Callable[[SkyDraws, SkyTexels], Numbers]

_OURS: dict[str, SkyFamily] = {
    "sun_and_sky": sun_and_sky,
    "clouds": clouds,
    "night": night,
    "softboxes": softboxes,
    "window_wall": window_wall,
    "lobes": lobes,
    "gradient": gradient,
    "constant": constant,
}

OUR_SKIES = tuple(_OURS)
"""What skies are drawn from unless the settings say otherwise; registering another does not change
it."""

SKIES: Registry[SkyFamily] = Registry("sky", Callable, _OURS, decides=("data",))
"""Every name that `SkyMapSettings.families` admits."""

"""Procedural environment maps (skies), by name of their family; extensions may add to them.

A family is a function of the draws of one sky and its texels; it returns the radiance [H, 2H, 3] up
to a factor, which `draw_sky` chooses. All that it draws has a name and a stated range, and its
noises take streams of their own, so that the same seed gives the same sky at every size.

Texels are those of a latitude-longitude (equirectangular) map. Orientation is that of Trilight's
environment maps and of Blender: +Z is up, the first row is the top, the middle of the picture is
+X, a quarter from its left edge is +Y, its edges are -X. Texel (i, j) of H rows and 2 H columns is
centred on u = (j + 0.5) / 2H and v = 1 - (i + 0.5) / H, and looks at azimuth (0.5 - u) 2 pi, from
+X towards +Y, and elevation (v - 0.5) pi.
"""

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import Range, require
from scene_templates.exact import (
    NOISE_SCALE,
    TEXELS_PER_CELL,
    Numbers,
    cosine,
    dot,
    fade,
    lerp,
    ramp,
    sine,
    smoothstep,
)
from scene_templates.recorded_sampler import RecordedSampler
from storage.registry import Registry
from storage.settings.described import checked
from storage.settings.ranges import Share, Within

LATTICE = 32
"""Cells after which noise in space repeats; the coarse octaves do not reach it."""

SPOT_RADIUS = 1.5
"""Radius of a spot in rows: the nearest texel centre is always inside."""


@dataclass(frozen=True)
class SkyTexels:
    """The texels of a map with `height` rows and twice as many columns."""

    height: int
    """Rows; a row is pi / height high."""

    @functools.cached_property
    def directions(self) -> Numbers:
        """[H, 2H, 3] unit vectors at the centres; read-only."""
        height = self.height
        elevation = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * np.pi
        azimuth = (0.5 - (np.arange(2 * height)[None, :] + 0.5) / (2 * height)) * 2 * np.pi
        flat = np.zeros((height, 2 * height))
        across = cosine(elevation)
        directions = np.stack(
            [across * cosine(azimuth), across * sine(azimuth), sine(elevation) + flat], axis=-1
        )
        directions.setflags(write=False)
        return directions

    @property
    def z(self) -> Numbers:
        """[H, 1] sine of the elevation."""
        return self.directions[:, :1, 2]

    @functools.cached_property
    def solid_angle(self) -> Numbers:
        """[H, 1] steradians of each texel of a row, in sum 4 pi over all texels; read-only."""
        edges = sine((0.5 - np.arange(self.height + 1) / self.height) * np.pi)
        solid_angle_sr = ((edges[:-1] - edges[1:]) * np.pi / self.height)[:, None]
        solid_angle_sr.setflags(write=False)
        return solid_angle_sr

    def flux(self, radiance: NDArray) -> Numbers:
        """Return the integral over the sphere of a map [H, 2H] or [H, 2H, 3]."""
        weight = self.solid_angle if radiance.ndim == 2 else self.solid_angle[..., None]
        return _sum(radiance * weight)

    def irradiance(self, radiance: NDArray) -> Numbers:
        """Return what a map [H, 2H, 3] sends onto a horizontal plane from above, [3]."""
        weight = self.solid_angle * np.maximum(self.z, 0)
        return _sum(radiance * weight[..., None])

    def lobe(self, towards: NDArray, sharpness: float) -> Numbers:
        """Return a round glow of unit flux [H, 2H]: 1 / (1 + sharpness (1 - cos angle))^2.

        Half of its light comes from where sharpness (1 - cos angle) is below about 1.
        """
        below = 1 + sharpness * (1 - dot(self.directions, towards))
        return self.of_unit_flux(1 / (below * below), towards)

    def spot(self, towards: NDArray) -> Numbers:
        """Return a spot of unit flux [H, 2H], brightest in the middle, 0 beyond its radius."""
        reach = 1 - float(cosine(min(1.0, SPOT_RADIUS / self.height) * np.pi))
        inside = 1 - (1 - dot(self.directions, towards)) / reach
        falloff = np.maximum(inside, 0)
        return falloff / self.flux(falloff)

    def pane(
        self,
        towards: NDArray,
        half_sizes: tuple[float, float],
        *,
        roll_rad: float = 0.0,
        panes: tuple[int, int] = (1, 1),
        bars: float = 0.0,
    ) -> Numbers:
        """Return how much of each texel [H, 2H] a rectangle covers, whose middle is `towards` [3].

        It has half of its width and height at distance 1, is turned about its middle, and divided
        into columns and rows of panes. The width of the bars between and around them is a share of
        a pane.
        """
        right, up = _axes(towards, roll_rad)
        ahead = dot(self.directions, towards)
        depth = np.maximum(ahead, 1e-9)
        covered = (ahead > 0).astype(np.float64)
        for axis, half, count in zip((right, up), half_sizes, panes, strict=True):
            across = (dot(self.directions, axis) / depth / half + 1) / 2 * count
            place = np.clip(np.floor(across), 0, count - 1)
            edge = 0.5 - np.abs(across - place - 0.5) - bars / 2
            covered = covered * ramp(edge * 2 * half / count * self.height / np.pi)
        return covered

    def noise(self, rng: np.random.Generator, cells: float, *, octaves: int = 1) -> Numbers:
        """Return noise [H, 2H] of mean 0, the same everywhere on the sphere: no seam and no poles.

        It is gradient noise in space, looked up on the sphere; each octave has half the amplitude.

        Args:
            rng: a stream of its own.
            cells: of the first octave along a radius.
            octaves: how many, as far as texels can show them.
        """
        total = np.zeros((self.height, 2 * self.height))
        gain = NOISE_SCALE
        for _ in range(octaves):
            if TEXELS_PER_CELL * np.pi * cells > self.height:
                break
            total = total + gain * _noise_in_space(self.directions * cells, rng)
            cells, gain = 2 * cells, gain / 2
        return total

    def of_unit_flux(self, shape: NDArray, towards: NDArray) -> Numbers:
        """Return a shape [H, 2H] with unit flux; a spot where it fell between all texels."""
        flux = float(self.flux(shape))
        return shape / flux if flux > 0 else self.spot(towards)


_texels_of = functools.lru_cache(maxsize=2)(SkyTexels)
"""Returns the texels of a height, the same ones while few heights are asked for."""


def _sum(values: NDArray) -> Numbers:
    """Return the sum over rows and columns, by rows first: the same order on every processor."""
    return np.add.accumulate(np.add.accumulate(values, axis=1)[:, -1], axis=0)[-1]


def _axes(towards: NDArray, roll_rad: float) -> tuple[Numbers, Numbers]:
    """Return two unit vectors across a direction; without a roll, the first one is level."""
    x, y, z = towards
    level = np.array([-y, x, 0.0]) if abs(z) < 0.999 else np.array([0.0, 1.0, 0.0])
    upright = np.cross(towards, level)
    level, upright = (axis / np.sqrt(dot(axis, axis)) for axis in (level, upright))
    turn_cos = float(cosine(roll_rad))
    turn_sin = float(sine(roll_rad))
    return turn_cos * level + turn_sin * upright, turn_cos * upright - turn_sin * level


def _noise_in_space(points: NDArray, rng: np.random.Generator) -> Numbers:
    """Return gradient noise at points [..., 3], of a lattice that repeats after LATTICE cells."""
    slopes = 2 * rng.random((3, LATTICE**3)) - 1
    axes = [np.ascontiguousarray(points[..., axis]) for axis in range(3)]
    corners = [np.floor(axis) for axis in axes]
    insides = [axis - corner for axis, corner in zip(axes, corners, strict=True)]
    fades = [fade(x) for x in insides]
    total = np.zeros(points.shape[:-1])
    for steps in itertools.product((0, 1), repeat=3):
        place = np.zeros(total.shape, np.int64)
        weight = np.ones_like(total)
        height = np.zeros_like(total)
        for corner, step, faded in zip(corners, steps, fades, strict=True):
            place = place * LATTICE + (corner.astype(np.int64) + step) % LATTICE
            weight = weight * (faded if step else 1 - faded)
        for slope, inside, step in zip(slopes, insides, steps, strict=True):
            height = height + slope[place] * (inside - step)
        total = total + height * weight
    return total


PALEST = 0.1
"""Least channel of a coloured light before its mean is made 1: no light is quite monochrome."""


DEEP_BLUE = (0.3, 0.75, 1.95)
PALE_BLUE = (0.75, 0.97, 1.28)
"""Colours, of mean 1, of a clean and of a hazy sky: bluer than any black body is."""


_TO_REC709 = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)


def planckian_rgb(mired: float) -> Numbers:
    """Return the linear colour [3], of mean 1, of a black body.

    By the cubic fit of Kim et al. (2002) to the chromaticities, which is polynomials alone. A mired
    is a million over the temperature in kelvin: 500 is a candle, 154 daylight, 40 blue sky. Equal
    steps look equal, as equal steps in kelvin do not.
    """
    t = mired / 1000
    if mired > 250:  # below 4,000 K
        x = ((-0.2661239 * t - 0.2343589) * t + 0.8776956) * t + 0.179910
    else:
        x = ((-3.0258469 * t + 2.1070379) * t + 0.2226347) * t + 0.240390
    if mired > 450:
        y = ((-1.1063814 * x - 1.34811020) * x + 2.18555832) * x - 0.20219683
    elif mired > 250:
        y = ((-0.9549476 * x - 1.37418593) * x + 2.09137015) * x - 0.16748867
    else:
        y = ((3.0817580 * x - 5.87338670) * x + 3.75112997) * x - 0.37001483
    xyz = (x / y, 1.0, (1 - x - y) / y)
    linear = [row[0] * xyz[0] + row[1] * xyz[1] + row[2] * xyz[2] for row in _TO_REC709]
    rgb = np.array([max(0.0, channel) for channel in linear])
    return rgb / _mean(rgb)


class SkyDraws(RecordedSampler):
    """Draws by name, and colours of lights that follow the sky's own choice."""

    def __init__(self, rng: np.random.Generator, settings: "SkyMapSettings") -> None:
        """Begin a sky.

        Args:
            rng: where the numbers come from.
            settings: ranges of the sky's sun, and probability of lights of any colour.
        """
        super().__init__(rng)
        self._coloured = self.holds("coloured lights", settings.coloured_share)
        self.settings = settings

    def light(self, name: str, *, mired: tuple[float, float]) -> Numbers:
        """Return the colour [3], of mean 1, of a light.

        Args:
            name: of the light.
            mired: natural range of its colour (`planckian_rgb`), uniform in it.
        """
        if not self._coloured:
            return planckian_rgb(self.uniform(f"{name}: mired", *mired))
        return self._any_colour(name)

    def blue(self, name: str) -> Numbers:
        """Return the colour [3], of mean 1, of a sky that is blue where lights are natural."""
        if not self._coloured:
            return self.shade(f"{name}: colour", DEEP_BLUE, PALE_BLUE)
        return self._any_colour(name)

    def _any_colour(self, name: str) -> Numbers:
        rgb = self.colour(f"{name}: any colour", (PALEST,) * 3, (1.0,) * 3)
        return rgb / _mean(rgb)


LOW_SUN_MIRED = 420.0
HIGH_SUN_MIRED = 172.0
"""2,400 K on the horizon and 5,800 K above: the light of a low sun has crossed more air."""


def sun_and_sky(draws: SkyDraws, texels: SkyTexels) -> Numbers:
    """A clear or hazy sky, bluest above and bright at the horizon, with a sun and its glow.

    The sun is a spot of a few texels at most. Its irradiance on a plane that faces it is the stated
    multiple of what the rest of the upper half sends onto a horizontal plane, wherever a texel of
    it is above the horizon.
    """
    towards = draws.direction("sun", *draws.settings.sun_elevation_deg)
    ratio = draws.uniform("irradiance of the sun over that of the sky", *draws.settings.sun_to_sky)
    zenith = draws.blue("zenith")
    horizon = draws.light("horizon", mired=(120, 170))
    brightening = draws.uniform("horizon over zenith", 1.5, 5.0)
    haze = draws.uniform("share of the glow around the sun", 0.02, 0.3)
    sharpness = draws.uniform("sharpness of the glow", 4.0, 60.0)
    s = min(max(float(towards[2]), 0.0), 1.0)
    sun = planckian_rgb(LOW_SUN_MIRED + (HIGH_SUN_MIRED - LOW_SUN_MIRED) * s * (2 - s))
    low = 1 - np.clip(texels.z, 0, 1)
    near = low * low * low
    sky = lerp(zenith, brightening * horizon, near[..., None]) + np.zeros((1, 2 * texels.height, 1))
    glow = texels.lobe(towards, sharpness)[..., None] * sun
    sky = sky * (1 - haze) + glow * (haze * _mean(texels.flux(sky)))
    from_sky = _mean(texels.irradiance(sky * _above_share(texels)[..., None]))
    spot = texels.spot(towards)
    seen = float(texels.flux(spot * _above_share(texels)))
    if seen > 0:  # otherwise the sun has set
        sky = sky + (spot / seen)[..., None] * sun * (ratio * from_sky)
    return _with_ground(draws, texels, sky)


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
    above = _above_share(texels)[..., None]
    ground = albedo * tint * texels.irradiance(sky * above) / np.pi
    return lerp(ground, sky, above)


def _above_share(texels: SkyTexels) -> Numbers:
    """[H, 1] how much of each row is above the horizon."""
    return np.clip(texels.height / 2 - np.arange(texels.height)[:, None], 0, 1)


def _mean(rgb: Numbers) -> float:
    return float((rgb[0] + rgb[1] + rgb[2]) / 3)


def shared_flux(texels: SkyTexels, one: Numbers, other: Numbers, share: float) -> Numbers:
    """Return the sum of two maps of which the first has `share` of the flux."""
    first = _mean(texels.flux(one))
    second = _mean(texels.flux(other))
    return one * (share / first) + other * ((1 - share) / second)


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

_OURS: tuple[SkyFamily, ...] = (
    sun_and_sky, clouds, night, softboxes, window_wall, lobes, gradient, constant,
)  # fmt: skip

SKIES: Registry[SkyFamily] = Registry(
    "sky", Callable, {make.__name__: make for make in _OURS}, decides=("data",)
)
"""Every name that `SkyMapSettings.families` admits."""

OUR_SKIES = tuple(SKIES)
"""What skies are drawn from unless the settings say otherwise; registering another does not change
it."""


@checked("sky settings")
class SkyMapSettings:
    """What procedural skies are drawn from."""

    families: tuple[str, ...] = OUR_SKIES
    """Families of skies, each equally likely; a name that stands twice is twice as likely."""
    height: Annotated[int, Within(1, 1024, unit="rows")] = 256
    """Rows of a map, which has twice as many columns. The same seed gives the same sky at every
    height, and the same irradiance of its sun."""
    mean_radiance: Annotated[Range, Within(0, 1e9)] = (0.2, 2.0)
    """Range of the mean radiance over the sphere and the three channels. A white Lambert floor
    under a constant sky has the radiance of the sky."""
    coloured_share: Share = 0.1
    """Share of the skies whose lights have any color; in the others, they are black bodies."""
    sun_elevation_deg: Annotated[Range, Within(-90, 90, unit="degrees")] = (2.0, 75.0)
    """Range of the elevation of a sun, uniform by solid angle."""
    sun_to_sky: Annotated[Range, Within(0, 1e9)] = (0.5, 8.0)
    """Range of the irradiance of a sun, on a plane that faces it, over the irradiance of the rest
    of the upper half of the sky on a horizontal plane."""

    def __post_init__(self) -> None:
        require(len(self.families) > 0, "families", self.families, "at least one")
        for name in self.families:
            SKIES.find(name)


def draw_sky(rng: np.random.Generator, settings: SkyMapSettings) -> tuple[str, NDArray[np.float32]]:
    """Draw a sky of one of the families, and return its name and the map.

    The map holds linear radiance [H, 2H, 3], the top row first.

    Equal generators and settings give equal bytes on every processor with IEEE arithmetic
    (scene_templates.exact). A sky of 256 rows takes 0.03 to 0.5 core-seconds.

    Args:
        rng: such as `rng_for(seed, "sky", number)`.
        settings: the ranges.
    """
    name = settings.families[int(rng.integers(len(settings.families)))]
    texels = _texels_of(settings.height)
    draws = SkyDraws(rng, settings)
    mean = draws.uniform("mean radiance", *settings.mean_radiance)
    shape = SKIES[name](draws, texels)
    red, green, blue = texels.flux(shape)
    scale = mean * 4 * np.pi * 3 / float(red + green + blue)
    return name, (shape * scale).astype(np.float32)


@checked("scene settings")
class SkySettings:
    """Share and strength of the skies of scenes."""

    share: Share = 0.0
    """Share of the scenes that have a sky beside their emitters."""
    own_share: Share = 0.0
    """Share of those skies that are of your own folder (`--skies`), each equally likely; the others
    are procedural, and so are all in a split to which none of the folder belongs."""
    over_lamps_log: Annotated[Range, Within(1e-6, 1e6)] = (0.02, 1.0)
    """Range, log-uniform, of the irradiance that a sky of constant radiance, the mean of the map,
    has on a surface, over that of all emitters at the middle of the room on surfaces that face
    them. It takes the place of `maps.mean_radiance`. In a scene without emitters it is the mean
    radiance itself."""
    seen_share: Share = 0.0
    """Share of the skies that cameras see behind everything."""
    maps: SkyMapSettings = field(default_factory=SkyMapSettings)
    """What procedural maps are drawn from. The height holds for your own too, as the most rows."""

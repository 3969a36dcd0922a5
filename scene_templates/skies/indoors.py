"""Light of studios and rooms: constant, gradient, lobes, softboxes, a wall of windows.

Each function takes the draws of one sky and its texels, and returns its radiance [H, 2H, 3] up to a
factor, which `draw_sky` chooses.
"""

import numpy as np

from scene_templates.exact import Numbers, dot, lerp, smoothstep
from scene_templates.skies.draws import SkyDraws
from scene_templates.skies.outdoors import shared_flux
from scene_templates.skies.texels import SkyTexels


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

"""The built-in families by name; a new one is a file and a line here."""

from collections.abc import Callable, Mapping

import numpy as np

from pipeline.objects.builtin.gear import gear_rand
from pipeline.objects.builtin.grids import Mesh
from pipeline.objects.builtin.superquadric import superquadric_rand
from pipeline.objects.builtin.torus_knot import torus_knot_rand
from pipeline.objects.builtin.vase import vase_rand

FAMILIES: Mapping[str, Callable[[np.random.Generator], Mesh]] = {
    "superquadric": superquadric_rand,
    "torus_knot": torus_knot_rand,
    "gear": gear_rand,
    "vase": vase_rand,
}
"""Object i of `builtin:` is of family i modulo their number. Order is part of the result."""

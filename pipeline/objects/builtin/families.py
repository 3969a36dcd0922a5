"""The built-in families by name; a new one is a file and a line here."""

from collections.abc import Callable, Mapping

import numpy as np

from pipeline.objects.builtin.furniture import furniture_rand
from pipeline.objects.builtin.gear import gear_rand
from pipeline.objects.builtin.grids import Mesh
from pipeline.objects.builtin.lattice import lattice_rand
from pipeline.objects.builtin.plant import plant_rand
from pipeline.objects.builtin.rock import rock_rand
from pipeline.objects.builtin.shell import shell_rand
from pipeline.objects.builtin.superquadric import superquadric_rand
from pipeline.objects.builtin.torus_knot import torus_knot_rand
from pipeline.objects.builtin.tree import tree_rand
from pipeline.objects.builtin.vase import vase_rand

FAMILIES: Mapping[str, Callable[[np.random.Generator], Mesh]] = {
    "superquadric": superquadric_rand,
    "torus_knot": torus_knot_rand,
    "gear": gear_rand,
    "vase": vase_rand,
    "rock": rock_rand,
    "shell": shell_rand,
    "furniture": furniture_rand,
    "tree": tree_rand,
    "lattice": lattice_rand,
    "plant": plant_rand,
}
"""Object i of `builtin:` is of family i modulo their number. Order is part of the result."""

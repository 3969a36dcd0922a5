"""The recipe by name: its methods and what can change its results; loads no mesh library."""

from importlib.metadata import version

_LIBRARIES = ("embreex", "libigl", "numpy", "pymeshlab", "trimesh")

RECIPE = " ".join(["assets-1", *(f"{name}={version(name)}" for name in _LIBRARIES)])
"""The number advances by hand whenever the same source would give other bytes."""

METHODS = ("pymeshlab_qem", "vertex_clustering")
"""Decimations in the order in which they are tried: the second where the first kills its child."""

"""Colors of all charts: what has a name here has the same color everywhere."""

PATH_TRACER = "#3b6ea5"
"""Blue; counts of a single kind have it too."""
NETWORK = "#e0883b"
"""Orange."""
TRACED = "#8ccf8c"
"""Light green: the traced pictures that others are compared with, and their noise."""
LIMIT = "#c8443f"
"""Red: targets and caps."""
SERIES = (PATH_TRACER, NETWORK, "#5f9e6e", "#a56cb4", "#8c8c8c", "#c8443f", "#4bb0b8", "#6b5b4b")
"""Kinds without a color of their own, in order of appearance."""
INK = "#333333"
FAINT = "#dddddd"

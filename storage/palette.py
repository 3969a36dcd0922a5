"""Colors of all charts: a method has the same one everywhere."""

PATH_TRACER = "#3b6ea5"
"""Blue; counts of one kind have it too."""
NETWORK = "#e0883b"
TRACED_LIGHT = "#5f9e6e"
METHOD_COLORS = {"path tracer": PATH_TRACER, "network": NETWORK, "traced light": TRACED_LIGHT}
"""Colors by the first words of a kind, up to its comma."""
OTHERS = ("#a56cb4", "#8c8c8c", "#c8443f", "#4bb0b8", "#6b5b4b")
"""Colors of everything else, in order of appearance."""
SERIES = (*METHOD_COLORS.values(), *OTHERS)
LIMIT = "#c8443f"
"""Red: targets and caps."""
INK = "#333333"
FAINT = "#dddddd"

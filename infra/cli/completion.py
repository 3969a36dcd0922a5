"""What a shell offers where a name is expected; called at every press of the tab key."""

from pipeline.flows.builds import BUILDS


def builds(incomplete: str) -> list[str]:
    """Return the named builds that begin so."""
    return [name for name in BUILDS if name.startswith(incomplete)]

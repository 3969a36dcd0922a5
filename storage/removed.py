"""The one sentence about what earlier versions stored and this one no longer reads."""

LAST_COMMIT = "643b412e"
"""The last commit that reads what was removed in November 2026."""


def removal_message(thing: str) -> str:
    """Return the refusal of `thing`, such as "weights.safetensors: sky tokens"."""
    return f"{thing}: removed since, and commit {LAST_COMMIT} is the last that reads it."

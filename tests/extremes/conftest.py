"""The rooms whose extremes are tested lend their fixtures."""

from tests.renders.conftest import variant
from tests.scenes.conftest import pool

__all__ = ["pool", "variant"]

"""The rooms whose extremes are tested lend their fixtures."""

from tests.renders.conftest import llvm, variant
from tests.scenes.conftest import pool

__all__ = ["llvm", "pool", "variant"]

"""The rooms whose extremes are tested lend their fixtures."""

from tests.pipeline.conftest import pool
from tests.pipeline.renders.conftest import llvm, variant

__all__ = ["llvm", "pool", "variant"]

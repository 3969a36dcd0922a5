"""Laws of renders are tested with the same variant as the renderer's own tests."""

from tests.pipeline.renders.conftest import llvm, variant

__all__ = ["llvm", "variant"]

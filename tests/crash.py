"""A crash of native code, for children: it imports nothing of the project."""

import os
import signal


def crash(*arguments: object) -> None:
    """End the process as a fault of memory does."""
    os.kill(os.getpid(), signal.SIGSEGV)


class CrashingRenderer:
    """Stands in for the object that a tracing child holds."""

    def __init__(self, *arguments: object) -> None:
        """Load no renderer, to be quick."""

    def wait(self) -> None:
        """Start the child."""

    def load(self, *arguments: object) -> None:
        """Crash where a scene is loaded."""
        crash()

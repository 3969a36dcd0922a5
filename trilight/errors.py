"""The exception for errors that the user can fix."""

from storage.errors import TrilightError

__all__ = ["TrilightError"]

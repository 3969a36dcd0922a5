"""What goes wrong for a reason that the user can mend."""

from storage.errors import TrilightError

__all__ = ["TrilightError"]

"""Check for PyTorch, which only training and networks need."""

import importlib.util
import os

from storage.errors import TrilightError


def require_torch(what: str) -> None:
    """Prepare this process for the first import of torch.

    torch's threads would spin while they wait, which made training beside other work twelve times
    slower. OpenMP reads the variable when torch is imported; a value that the user set wins.

    Raises:
        TrilightError: `what` needs torch, and it is not installed.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if importlib.util.find_spec("torch") is None:
        raise TrilightError(
            f"{what} needs PyTorch, which is not installed. Run make setup-all, or "
            "pip install 'trilight[train]'."
        )

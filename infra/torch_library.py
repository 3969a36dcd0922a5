"""PyTorch, which making data does not need: refused in one line where it is missing."""

import importlib.util
import os

from storage.errors import TrilightError


def require_torch(what: str) -> None:
    """Prepare this process for the first import of torch.

    torch's threads would wait for each other in busy loops, which beside other work made training
    twelve times slower. OpenMP reads when torch is imported how it should wait; a setting of the
    user's own wins.

    Raises:
        TrilightError: `what` needs torch, and it is not installed.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if importlib.util.find_spec("torch") is None:
        raise TrilightError(
            f"{what} needs PyTorch, which is not installed. Run make setup-all, or "
            "pip install 'trilight[train]'."
        )

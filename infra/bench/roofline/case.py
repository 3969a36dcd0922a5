"""What a roofline is asked about. Without torch."""

import dataclasses


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """What is asked about: one step of one pass, of as many scenes as the run puts into a pass."""

    run: str
    """A named run."""
    size: str | None = None
    """A name of model.config.SIZES; None: the run's own network."""
    card: str = "H100-80"
    """A name of CARDS."""
    is_compiled: bool = True
    """Whether layers, head and LPIPS are compiled (an estimate: fusion), or kernel by kernel."""
    recomputes: bool | None = None
    """Whether activations are recomputed; None: as the run says."""

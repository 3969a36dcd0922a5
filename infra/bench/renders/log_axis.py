"""Logarithmic axes that say 0.3, 20 and 5000 instead of powers of ten."""

from typing import Any

from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter


def plain_log(axis: Any, per_decade: tuple[float, ...] = (1, 2, 3, 5, 7)) -> None:
    """Label one axis (`axes.xaxis` or `axes.yaxis`), logarithmic already, at round numbers."""
    axis.set_major_locator(LogLocator(subs=per_decade))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.10g}"))
    axis.set_minor_formatter(NullFormatter())

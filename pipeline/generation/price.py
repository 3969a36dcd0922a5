"""The price of computing: one range for the options and the environment."""

from typing import Annotated

from storage.settings.described import checked
from storage.settings.ranges import Within

USD_PER_CORE_HOUR = 0.04
"""Default price of a core-hour."""
PRICES = Within(0, 1000, unit="USD per core-hour")
"""Range of prices; its upper end is ten thousand times the usual rent of a core."""


@checked()
class CorePrice:
    """The price of computing."""

    price: Annotated[float, PRICES] = USD_PER_CORE_HOUR
    """Price of one core for an hour, in USD."""

"""What computing costs: one range for the options and the environment."""

from typing import Annotated

from storage.settings.described import checked
from storage.settings.ranges import Within

USD_PER_CORE_HOUR = 0.04
"""Unless somebody says otherwise."""
PRICES = Within(0, 1000, unit="USD per core-hour")
"""Ten thousand times what a core is rented for."""


@checked()
class CorePrice:
    """What computing costs."""

    price: Annotated[float, PRICES] = USD_PER_CORE_HOUR
    """USD for an hour of one core."""

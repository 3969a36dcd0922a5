"""What computing costs: one range for the options and the environment."""

from typing import Annotated

from storage.ranges import Within
from storage.settings import checked

USD_PER_CORE_HOUR = 0.04
"""Unless somebody says otherwise."""
PRICES = Within(0, 1000, unit="USD per core-hour")
"""Ten thousand times what a core is rented for."""


@checked(option="--{}".format)
class CorePrice:
    """What `--price` says, of `plan`, `status` and `bench`."""

    price: Annotated[float, PRICES] = USD_PER_CORE_HOUR
    """An hour of one core."""

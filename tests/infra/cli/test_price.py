"""`--price` of whatever says what computing costs: one range, and one clear line outside of it."""

from storage.errors import TrilightError
from tests.command_line import trilight
from tests.for_each import case


def test_a_price_that_is_none_is_refused_before_anything_is_done() -> None:
    for price in ["-1", "nan", "inf", "1000.5"]:
        for command in [("plan", "smoke"), ("status", "nowhere")]:
            with case((price, command)):
                told = trilight([*command, "--price", price])
                assert isinstance(told.exception, TrilightError)
                assert str(told.exception) == (
                    f"--price is {float(price)!r}; expected a number from 0 to 1000 USD "
                    "per core-hour."
                )

"""A name that nobody knows brings the near one, and all that are known."""

from storage.errors import expected_one_of


def test_the_near_name_comes_first() -> None:
    assert expected_one_of("smok", ["pretrain", "smoke"]) == (
        "did you mean smoke? Expected one of pretrain, smoke"
    )


def test_where_none_is_near_all_are_named() -> None:
    assert expected_one_of("xyz", ["pretrain", "smoke"]) == "expected one of pretrain, smoke"

"""Words of the command line: what a field takes does not depend on whether it may be left out."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

from infra.cli.words import choices_of, is_repeated, kind_of, takes_names, value_of
from tests.for_each import case

WORDS: dict[Any, tuple[str | tuple[str, ...], Any]] = {
    int: ("3", 3),
    float: ("0.5", 0.5),
    str: ("3", "3"),
    Path: ("a/b", Path("a/b")),
    Literal["fast", "high"]: ("fast", "fast"),
    tuple[float, ...]: (("1", "2.5"), (1.0, 2.5)),
    tuple[Literal["a", "b"], ...]: (("a", "b"), ("a", "b")),
    Mapping[str, Any]: (("a.b=3", "c=x"), {"a.b": 3, "c": "x"}),
}


def test_an_optional_field_takes_the_words_that_it_takes_otherwise() -> None:
    for hint, (words, value) in WORDS.items():
        for each in (hint, hint | None, Optional[hint], Annotated[hint | None, "a note"]):  # noqa: UP045
            with case(each):
                assert value_of(words, each) == value
                for ask in (choices_of, kind_of, is_repeated, takes_names):
                    assert ask(each) == ask(hint)

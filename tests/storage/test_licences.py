"""What licences ask for, and which may meet."""

from pipeline.objects.licences import DEFAULT_ALLOWED, UNKNOWN, USER_PROVIDED
from storage.licences import (
    DUTIES,
    duties_of,
    licence_url,
    mixed_share_alike,
    share_alike_camp,
    union_of_duties,
)
from tests.for_each import for_each


@for_each(
    ("licence", "duties"),
    [
        ("CC0-1.0", ()),
        ("CC-BY-4.0", ("attribution", "changes")),
        ("cc-by-sa-3.0", ("attribution", "changes", "share-alike")),
        ("CC-BY-SA-3.0-DE", ("attribution", "changes", "share-alike")),
        ("CC-BY-NC-ND-4.0", ("attribution", "changes", "non-commercial", "no-derivatives")),
        ("Apache-2.0", ("changes", "notice")),
        ("MIT", ("notice",)),
        ("GPL-3.0-or-later", ("changes", "notice", "share-alike")),
        ("ODbL-1.0", ("attribution", "notice", "share-alike")),
    ],
)
def test_duties_by_identifier(licence: str, duties: tuple[str, ...]) -> None:
    assert duties_of(licence) == duties
    assert licence_url(licence) is not None


@for_each(
    "licence",
    [USER_PROVIDED, UNKNOWN, "MIT OR Apache-2.0", "CC-BY", "CC-XX-4.0", "", "CC-BY-4.0\nx: y"],
)
def test_what_is_unknown_is_not_guessed(licence: str) -> None:
    assert duties_of(licence) is None
    assert licence_url(licence) is None
    assert share_alike_camp(licence) == ""


def test_what_is_allowed_by_default_is_known_and_permits_commercial_and_derived_use() -> None:
    for licence in DEFAULT_ALLOWED:
        if licence != USER_PROVIDED:
            duties = duties_of(licence)
            assert duties is not None, licence
            assert not {"non-commercial", "no-derivatives"} & set(duties)


def test_the_union_is_in_the_order_of_the_table_and_passes_over_the_unknown() -> None:
    found = union_of_duties(["MIT", "CC-BY-NC-4.0", USER_PROVIDED, "CC-BY-SA-4.0"])
    assert found == tuple(duty for duty in DUTIES if duty != "no-derivatives")
    assert union_of_duties([]) == union_of_duties(["CC0-1.0"]) == ()


def test_camps_are_single_licences() -> None:
    assert share_alike_camp("CC-BY-SA-4.0") == share_alike_camp("cc-by-sa-4.0") != ""
    assert share_alike_camp("CC-BY-SA-4.0") != share_alike_camp("CC-BY-SA-3.0")
    assert share_alike_camp("CC-BY-SA-3.0") != share_alike_camp("CC-BY-SA-3.0-DE")
    assert share_alike_camp("CC-BY-4.0") == share_alike_camp("CC-BY-ND-4.0") == ""


def test_two_share_alike_licences_may_not_meet() -> None:
    """Writing one in small letters makes no second licence of it."""
    assert mixed_share_alike(["CC0-1.0", "CC-BY-SA-4.0", "cc-by-sa-4.0", "MIT"]) == []
    both = ["CC-BY-SA-4.0", "MIT", "CC-BY-SA-3.0"]
    assert mixed_share_alike(both) == ["CC-BY-SA-3.0", "CC-BY-SA-4.0"]

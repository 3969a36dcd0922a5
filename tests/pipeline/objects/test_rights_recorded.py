"""`attribution.csv` says not only the licence of an object, but who says so."""

import csv
import io

from pipeline.documents.attribution import encode_attribution
from storage.records.objects import LockedObject


def test_the_source_of_a_licence_is_published() -> None:
    entry = LockedObject(
        uid="a",
        asset_sha256="0" * 64,
        split="train",
        licence="CC-BY-4.0",
        licence_source="=Objaverse 1.0, published 2019-05-03",
        title="A",
        attribution="Ada",
        source_url="https://v/a",
    )
    (row,) = csv.DictReader(io.StringIO(encode_attribution([entry]).decode()))
    assert list(row)[:4] == ["uid", "title", "licence", "licence_source"]
    # the quote keeps a spreadsheet from taking it for a formula
    assert row["licence_source"] == "'=Objaverse 1.0, published 2019-05-03"
    assert (row["licence"], row["attribution"]) == ("CC-BY-4.0", "Ada")

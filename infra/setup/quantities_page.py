"""Writes docs/reference/quantities.md: what can be asked of a scene in `--where`."""

from pathlib import Path

from pipeline.documents.markdown import table
from pipeline.shards.expression import TEXTS
from storage.records.quantities import QUANTITIES

FILE = Path(__file__).parents[2] / "docs/reference/quantities.md"

_HEAD = """# What can be asked of a scene

Made by `make settings` from `storage/records/quantities.py` and `pipeline/shards/expression.py`.

```sh
trilight shards list DATA --where 'max(roughness) < 0.3 and lights_per_scene > 1'
trilight shards select DATA --out NEW --where 'template in ("plane", "room") and min(coverage) > 0'
trilight shards select DATA --out NEW --where 'min(noise_floor_linear_db) >= 35 and not any(at_cap)'
```

A condition compares numbers (`<`, `<=`, `>`, `>=`, `==`, `!=`, with `+`, `-`, `*`, `/`) and texts
(`==`, `!=`, `in`), joined by `and`, `or` and `not`. What a scene has several of goes through
`min(...)`, `max(...)` or `mean(...)`, truths through `any(...)` or `all(...)`. Of no values at all
these are not a number, and no comparison with that holds. Nothing else is carried out.
"""


def main() -> None:
    """Write the file."""
    FILE.write_text(quantities_page())


def quantities_page() -> str:
    """Return docs/reference/quantities.md."""
    numbers = [
        (f"`{name}`", "a number" if each.per == "scene" else f"numbers, for each {each.per}",
         each.label)
        for name, each in QUANTITIES.items()
    ]  # fmt: skip
    others = [(f"`{name}`", _KINDS[kind], means) for name, (kind, means) in TEXTS.items()]
    return f"{_HEAD}\n{table(('name', 'what it is', 'of what'), [*numbers, *others])}\n"


_KINDS = {"text": "a text", "texts": "texts", "truths": "truths"}


if __name__ == "__main__":
    main()

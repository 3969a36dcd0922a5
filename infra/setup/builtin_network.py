"""Writes a built-in network: its folder in `model/builtin/`, with weights and model card.

    trilight evaluate RUN --data SET --split test --out EVALUATION
    python -m infra.setup.builtin_network RUN --data SET --evaluation EVALUATION --command "..."

With `--also OTHER`, the card has evaluations on other sets, too, such as benchmark-v1.

The training data must have only objects under CC0, and the weights must be small.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import cyclopts
from cyclopts import Parameter
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image

from model.open import BUILTIN_NETWORKS, open_network
from model.weights import network_digest
from storage.atomic import write_atomically
from storage.dataset.dataset import Dataset, open_dataset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.objects import read_objects_lock
from train.evaluation.evaluate import sentences
from train.evaluation.metrics import NETWORK
from train.evaluation.report_pages import scores_table, swapped_text
from train.folder import RunFolder

MOST_BYTES = 10_000_000
"""Maximum size of the weights, since every clone of the project holds them."""

_SHEETS = ("median", "worst")
"""Sheets of the evaluation that the card shows."""

ALLOWED_LICENCES = {"CC0-1.0"}


def main(
    run: Annotated[Path, Parameter(help="folder of the finished run")],
    data: Annotated[str, Parameter(help="root of the dataset that it learned from")],
    evaluation: Annotated[Path, Parameter(help="folder that `trilight evaluate` wrote")],
    command: Annotated[str, Parameter(help="how the dataset was made, for the card")],
    also: Annotated[tuple[Path, ...], Parameter(help="folders of other evaluations of it")] = (),
    name: Annotated[str, Parameter(help="by which it will be opened")] = "builtin:hits",
) -> None:
    """Copy the weights and write the model card."""
    folder = RunFolder(run)
    dataset = open_dataset(data)
    weights = folder.weights.read_bytes()
    about = json.loads(folder.settings.read_text())
    every = [json.loads((each / "evaluation.json").read_text()) for each in (evaluation, *also)]
    judged, *other_evaluations = every
    _check(dataset, weights, about, judged["about"])
    digest = network_digest(open_network(folder.weights))
    for each in every:
        if each["about"]["network sha256"] != digest:
            raise TrilightError("builtin network: another network was judged.")
    place = BUILTIN_NETWORKS[name]
    card = card_text(
        name=name,
        dataset=dataset,
        judged=judged,
        others=other_evaluations,
        summary=json.loads(folder.summary.read_text()),
        weights=weights,
        command=command,
        settings=about["settings"],
    )
    for sheet in _SHEETS:
        Image.open(evaluation / f"{sheet}.png").save(place.with_name(f"{sheet}.webp"), quality=80)
    write_atomically(place, weights)
    write_atomically(place.with_name("README.md"), card.encode())


def _check(
    dataset: Dataset, weights: bytes, run: Mapping[str, Any], judged: Mapping[str, Any]
) -> None:
    licences = {entry.licence for entry in read_objects_lock(dataset.folder.objects_lock)}
    for law, complaint in (
        (len(weights) <= MOST_BYTES, f"{len(weights)} bytes; expected at most {MOST_BYTES}"),
        (run["data_digest"] == dataset.digest, "the run learned from other data than --data"),
        (judged["data digest"] == dataset.digest, "it was judged on other data"),
        (judged["split"] == "test", "it was not judged on the test split"),
        (
            judged["resolution"] == run["settings"]["resolution"],
            "it was not judged at the resolution of the run",
        ),
        (licences <= ALLOWED_LICENCES, f"objects under {', '.join(sorted(licences))}; CC0 only"),
    ):
        if not law:
            raise TrilightError(f"builtin network: {complaint}.")


def card_text(**values: Any) -> str:
    """Return the model card, network_card.jinja with its values filled in."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template("network_card.jinja").render(
        **values,
        # the network first: a report has the methods by their names
        contestants_table=lambda scores: scores_table({NETWORK: scores[NETWORK], **scores}),
        json=json,
        sentences=sentences,
        sha256_hex=sha256_hex,
        sheets=_SHEETS,
        swapped_text=swapped_text,
    )


if __name__ == "__main__":
    try:
        cyclopts.run(main)
    except TrilightError as mistake:
        raise SystemExit(str(mistake)) from mistake

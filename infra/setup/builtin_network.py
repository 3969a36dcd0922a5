"""Ships a trained network: `model/builtin/`, its weights and its card.

    trilight evaluate RUN --data SET --split test --out EVALUATION
    python -m infra.setup.builtin_network RUN --data SET --evaluation EVALUATION --command "..."

Only data of objects that ask for nothing (CC0) may be behind it, and only a small file is shipped.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import cyclopts
from cyclopts import Parameter

from model.open import BUILTIN, BUILTIN_WEIGHTS
from model.weights import decode_weights, network_digest
from storage.atomic import write_atomically
from storage.dataset.dataset import Dataset, open_dataset
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.objects import read_objects_lock
from train.evaluation.judged_view import NETWORK
from train.folder import RunFolder

MOST_BYTES = 8_000_000
"""Of the weights: everybody who clones the project gets them."""

_HEAD = (
    f"# The network that comes with Trilight (`{BUILTIN}`)",
    "",
    "What `trilight render --engine neural` uses where no other is named: small enough to ship and "
    "to train on two processor cores, and as blurred as that makes it. It shows that everything "
    "works, and is something to beat; it does not replace the path tracer.",
    "",
)

ALLOWED_LICENCES = {"CC0-1.0"}


def main(
    run: Annotated[Path, Parameter(help="folder of the finished run")],
    data: Annotated[str, Parameter(help="root of the dataset that it learned from")],
    evaluation: Annotated[Path, Parameter(help="folder that `trilight evaluate` wrote")],
    command: Annotated[str, Parameter(help="how the dataset was made, for the card")],
) -> None:
    """Copy the weights and write the card."""
    folder, dataset = RunFolder(run), open_dataset(data)
    weights = folder.weights.read_bytes()
    about = json.loads(folder.settings.read_text())
    judged = json.loads((evaluation / "evaluation.json").read_text())
    _check(dataset, weights, about, judged["about"])
    place = BUILTIN_WEIGHTS
    write_atomically(place, weights)
    card = _card(dataset, about, judged, json.loads(folder.summary.read_text()), weights, command)
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
            judged["network sha256"] == network_digest(decode_weights(weights)),
            "another network was judged",
        ),
        (
            judged["resolution"] == run["settings"]["resolution"],
            "it was not judged at the resolution of the run",
        ),
        (licences <= ALLOWED_LICENCES, f"objects under {', '.join(sorted(licences))}; CC0 only"),
    ):
        if not law:
            raise TrilightError(f"builtin network: {complaint}.")


def _card(
    dataset: Dataset,
    about: Mapping[str, Any],
    judged: Mapping[str, Any],
    summary: Mapping[str, Any],
    weights: bytes,
    command: str,
) -> str:
    settings, model = about["settings"], about["settings"]["model"]
    swapped = judged["swapped scenes"]
    most = dataset.manifest.settings["scenes"]["max_triangles"]
    shape = (
        f"{summary['num_parameters']} parameters ({model['encoder_layers']} and "
        f"{model['decoder_layers']} layers, {model['width']} wide, {model['head']} head)"
    )
    lines = [
        *_HEAD,
        f"- weights: `model.safetensors`, {len(weights)} bytes, sha256 `{sha256_hex(weights)}`",
        f"- size: {shape}",
        "- licence: Trilight's (MIT); its data was made from built-in objects, all CC0-1.0",
        f"- data: {dataset.manifest.num_scenes} scenes, dataset digest `{dataset.digest}`, by",
        "",
        f"      {command}",
        "",
        f"- training: `trilight train {settings['run']}`, {summary['num_steps']} steps of "
        f"{settings['scenes_per_step']} scenes and {settings['views_per_scene']} views, "
        f"{settings['resolution']} x {settings['resolution']} pixels; all settings below",
        f"- range: at most {most} triangles and pictures of {settings['resolution']} pixels; "
        "beyond either it warns and gets worse",
        "",
        *_scores(judged),
        "",
        f"With the triangles of another scene it loses {swapped['median_db']:.2f} dB of "
        f"psnr_log_db in the median and {swapped['mean_db']:.2f} dB on average.",
        "",
        "```json",
        json.dumps(settings, indent=1, sort_keys=True),
        "```",
        "",
    ]
    return "\n".join(lines)


def _scores(judged: Mapping[str, Any]) -> list[str]:
    everybody = judged["contestants"]
    contestants = {NETWORK: everybody[NETWORK]} | everybody  # the file has them by their names
    return [
        f"Scores on the test split ({judged['about']['scenes']} scenes, {len(judged['views'])} "
        "views, objects that it has not seen; medians):",
        "",
        f"| metric | {' | '.join(contestants)} |",
        f"|{'---|' * (len(contestants) + 1)}",
        *(
            f"| {metric} | {' | '.join(_shown(who[metric]) for who in contestants.values())} |"
            for metric in judged["metrics"]
        ),
    ]


def _shown(figures: Mapping[str, Any]) -> str:
    return "n/a" if figures["median"] is None else f"{figures['median']:.4g}"


if __name__ == "__main__":
    try:
        cyclopts.run(main)
    except TrilightError as mistake:
        raise SystemExit(str(mistake)) from mistake

"""Writes a built-in network: its folder in `model/builtin/`, with weights and model card.

    trilight evaluate RUN --data SET --split test --out EVALUATION
    python -m infra.setup.builtin_network RUN --data SET --evaluation EVALUATION --command "..."

With `--also OTHER`, the card has evaluations on other sets, too, such as benchmark-v1.

The training data must have only objects under CC0, and the weights must be small.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import cyclopts
from cyclopts import Parameter
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

_HEADS = {
    "builtin:hits": (
        "What `trilight render --engine neural` uses where no other is named: first hits, direct "
        "light and one bounce are traced, and the network filters what is noisy and learns what is "
        "left out. Small enough to ship and to train on two processor cores in an hour."
    ),
    "builtin:tokens": (
        "RenderFormer as published, small enough to ship and to train on two processor cores, and "
        "as blurred as that makes it. It shows that everything works, and is something to beat; it "
        "does not replace the path tracer."
    ),
}
"""Introduction of each built-in network's card, by its name."""

_SHEETS = ("median", "worst")
"""Sheets of the evaluation that the card shows."""

WORST = 5
"""Number of worst views on the card."""

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
    summary = json.loads(folder.summary.read_text())
    lines = [f"# The network `{name}`", "", _HEADS[name], ""]
    lines += _card(dataset, about, judged, summary, weights, command)
    for sheet in _SHEETS:
        Image.open(evaluation / f"{sheet}.png").save(place.with_name(f"{sheet}.webp"), quality=80)
        lines += [
            "",
            f"![Views of {sheet} error, beside the path tracer in equal time]({sheet}.webp)",
        ]
    for each in other_evaluations:
        lines += ["", *_scores(each)]
    lines += [
        "",
        "```json",
        json.dumps(about["settings"], indent=1, sort_keys=True),
        "```",
        "",
    ]
    write_atomically(place, weights)
    write_atomically(place.with_name("README.md"), "\n".join(lines).encode())


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


def _card(
    dataset: Dataset,
    about: Mapping[str, Any],
    judged: Mapping[str, Any],
    summary: Mapping[str, Any],
    weights: bytes,
    command: str,
) -> list[str]:
    settings = about["settings"]
    model = about["settings"]["model"]
    most = dataset.manifest.settings["scenes"]["max_triangles"]
    by_hits = model.get("view_stage") == "hits"
    encoder = model["encoder_layers"] if model.get("scene_tokens", True) else 0
    shape = (
        f"{summary['num_parameters']} parameters ({encoder} and "
        f"{model['decoder_layers']} layers, {model['width']} wide, {model['head']} head)"
    )
    px = settings["resolution"]
    limits = f"at most {most} triangles" + ("" if by_hits else f" and pictures of {px} pixels")
    return [
        f"- weights: `model.safetensors`, {len(weights)} bytes, sha256 `{sha256_hex(weights)}`",
        f"- size: {shape}",
        "- licence: Trilight's (MIT); its data was made from built-in objects, all CC0-1.0",
        f"- data: {dataset.manifest.num_scenes} scenes, dataset digest `{dataset.digest}`, by",
        "",
        f"      {command}",
        "",
        f"- training: `trilight train {settings['run']}`, {summary['num_steps']} steps of "
        f"{settings['scenes_per_step']} scenes and {settings['views_per_scene']} views, "
        f"{px} x {px} pixels; all settings below",
        f"- range: {limits}; beyond that it warns and gets worse",
        "",
        *_scores(judged),
    ]


def _scores(judged: Mapping[str, Any]) -> list[str]:
    all_scores = judged["contestants"]
    about = judged["about"]
    ordered = {NETWORK: all_scores[NETWORK]} | all_scores  # the file has them by their names
    traced = judged["path tracer"] or {}
    lines = [
        f"Scores on {about['scenes']} scenes of split {about['split']} of build {about['build']}, "
        f"{len(judged['views'])} views of {about['resolution']} pixels, objects that it has not "
        f"seen (`{about['data']}`, dataset digest {about['data digest'][:8]}); medians, in "
        "brackets the worse 5 %:",
        "",
        scores_table(ordered),
    ]
    if traced:
        lines += ["", " ".join(sentences(traced))]
    if swapped := judged["swapped scenes"]:
        lines += ["", swapped_text(swapped)]
    return [*lines, "", _worst(judged["views"])]


def _worst(views: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on the views with the greatest error."""
    by_error = sorted(views, key=lambda view: view["scores"][NETWORK]["psnr_log_db"])
    each = [
        f"{view['key']} ({view['scores'][NETWORK]['psnr_log_db']:.1f} dB, {view['template']}, "
        f"{view['num_lights']} light{'s' * (view['num_lights'] != 1)}, "
        f"mean roughness {view['roughness']:.2f})"
        for view in by_error[:WORST]
    ]
    return f"Worst views, by scene: {'; '.join(each)}."


if __name__ == "__main__":
    try:
        cyclopts.run(main)
    except TrilightError as mistake:
        raise SystemExit(str(mistake)) from mistake

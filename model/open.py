"""Opens a network from any source; the only place that does, and without pickle.

ours, shipped      builtin:hits (builtin: for short), builtin:tokens
our own            model.safetensors of `trilight train`, or the folder that holds one
published, local   a folder with config.json and model.safetensors
published, hub     microsoft/renderformer-v1-base, microsoft/renderformer-v1.1-swin-large

A caller may add forms: `open_network(place, network_of_run)` also opens the checkpoints of training
(train.loop.checkpoints).
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from safetensors.torch import save

from model.published.config import PublishedConfig, decode_published, encode_published
from model.published.convert import from_published, to_published
from model.renderformer import RenderFormer
from model.weights import (
    CONFIG_KEY,
    PUBLISHED_RANGE,
    TrainedRange,
    decode_config,
    from_tensors,
    read_metadata,
    read_tensors,
    trained_range,
)
from storage.atomic import write_atomically
from storage.errors import TrilightError, expected_one_of
from storage.records.safe_read import open_plain

WEIGHTS_NAME, CONFIG_NAME = "model.safetensors", "config.json"
"""What a checkpoint's folder holds; only published ones have the second."""

PUBLISHED = ("microsoft/renderformer-v1-base", "microsoft/renderformer-v1.1-swin-large")
"""The published checkpoints' names on the Hugging Face hub."""

_SHIPPED = Path(__file__).parent / "builtin"

BUILTIN = "builtin:"
"""Name of the better of the small networks that come with Trilight."""

BUILTIN_TOKENS = "builtin:tokens"
"""Name of the one whose view stage is RenderFormer's: nothing is traced."""

BUILTIN_NETWORKS = {
    BUILTIN: _SHIPPED / "hits" / WEIGHTS_NAME,
    "builtin:hits": _SHIPPED / "hits" / WEIGHTS_NAME,
    BUILTIN_TOKENS: _SHIPPED / "tokens" / WEIGHTS_NAME,
}
"""File of each network that comes along, by its name; its card, README.md, is beside it."""

MAX_CONFIG_BYTES = 1 << 16
"""A published config.json has about 1 KiB."""

_ANSWER_S = 5.0
"""Time limit for the hub's first answer; without one, files fetched before are used."""

_HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")
_PICKLES = (".pt", ".pth", ".bin", ".ckpt", ".pkl")


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundNetwork:
    """A network that is there; its weights are read when it is opened."""

    path: Path
    """The file that holds them."""
    trained: TrainedRange
    """What it was trained on, as far as the file says."""
    any_width: bool
    """Whether pictures of other widths than that are as good."""
    open: Callable[[], RenderFormer]
    """Returns the network, float32, in evaluation mode on the CPU; raises TrilightError where the
    file is damaged, or its tensors are not those of its configuration."""


Finder = Callable[[Path], FoundNetwork | None]
"""Finds the network of a place in a form that this package does not know, such as a training
checkpoint (train.loop.checkpoints); returns None for any other place."""


def open_network(place: str | Path, *finders: Finder) -> RenderFormer:
    """Return a network, float32, in evaluation mode on the CPU.

    Args:
        place: as in `find_network`.
        finders: as there.

    Raises:
        TrilightError: there is none, it holds pickled code, it is damaged, or its tensors are not
            those of its configuration; names are listed.
    """
    return find_network(place, *finders).open()


def find_network(place: str | Path, *finders: Finder) -> FoundNetwork:
    """Return a network before its weights are read; of a published name, after it is fetched.

    Args:
        place: one of BUILTIN_NETWORKS, a file, a folder, or the name of a repository on the
            Hugging Face hub.
        finders: are asked first, such as `train.loop.checkpoints.network_of_run`.

    Raises:
        TrilightError: there is none, or it holds pickled code.
    """
    source = str(place)
    if source.startswith(BUILTIN) and source not in BUILTIN_NETWORKS:
        raise TrilightError(
            f"checkpoint {source}: no such network comes along; "
            f"{expected_one_of(source, sorted(BUILTIN_NETWORKS))}."
        )
    path = BUILTIN_NETWORKS.get(source, Path(source))
    for finder in finders:
        if found := finder(path):
            return found
    weights = _weights_file(source, path)
    metadata = read_metadata(weights)
    if CONFIG_KEY in metadata:
        return FoundNetwork(
            path=weights,
            trained=trained_range(metadata) or TrainedRange(),
            any_width=decode_config(metadata[CONFIG_KEY], str(weights)).view_stage == "hits",
            open=lambda: from_tensors(*read_tensors(weights), str(weights)),
        )
    return FoundNetwork(
        path=weights,
        trained=PUBLISHED_RANGE,
        any_width=False,
        open=lambda: _published(weights),
    )


def _weights_file(source: str, path: Path) -> Path:
    """Return the safetensors file that is meant; raises as `find_network`."""
    if not path.exists():
        is_path = path.suffix in (*_PICKLES, ".safetensors") or source.startswith("runs/")
        if is_path or not _HUB_NAME.fullmatch(source):
            raise TrilightError(
                f"checkpoint {source}: no such file or folder; expected one, or a published name "
                f"such as {PUBLISHED[0]}."
            )
        path = _download(source)
    weights = path / WEIGHTS_NAME if path.is_dir() else path
    if path.is_dir() and not weights.exists() and not _has_pickles(path):
        raise TrilightError(
            f"checkpoint {source}: no checkpoint here; expected {WEIGHTS_NAME}, as `trilight "
            "train` writes it and published folders hold it."
        )
    if weights.suffix in _PICKLES or not weights.exists():
        raise TrilightError(
            f"checkpoint {source}: expected {WEIGHTS_NAME}; pickled weights could run code and are "
            "not read. Convert them with the tool that wrote them."
        )
    return weights


def _published(weights: Path) -> RenderFormer:
    tensors, _ = read_tensors(weights)
    return from_published(tensors, _read_config(weights.parent / CONFIG_NAME))


def _has_pickles(folder: Path) -> bool:
    return any(path.suffix in _PICKLES for path in folder.iterdir())


def save_published(model: RenderFormer, folder: Path) -> None:
    """Write a network as a published checkpoint: config.json and model.safetensors.

    Its texture input is as wide as that of its family, so that their loader feeds it as it does
    theirs. A network that was trained here has its registers at the exact mean of the triangles;
    their code puts them 1e-5 / T nearer to the origin.

    Raises:
        TrilightError: the network is of neither published family, or the folder cannot be written.
    """
    texture_patch = 1 if model.config.window_bundles else 32
    config = PublishedConfig(model=model.config, texture_patch=texture_patch)
    text = json.dumps(encode_published(config), indent=2)
    tensors = {name: x.contiguous() for name, x in to_published(model, texture_patch).items()}
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / WEIGHTS_NAME, save(tensors, metadata={"format": "pt"}))
    write_atomically(folder / CONFIG_NAME, text.encode())


def _read_config(path: Path) -> PublishedConfig:
    try:
        with open_plain(path) as file:
            fields = json.loads(file.read(MAX_CONFIG_BYTES))
    except OSError as error:
        raise TrilightError(
            f"{path}: cannot be read ({error.strerror}); weights that carry no configuration of "
            "ours need the published one beside them."
        ) from error
    except (ValueError, RecursionError) as error:
        raise TrilightError(f"{path}: not JSON ({error}).") from error
    if not isinstance(fields, dict):
        raise TrilightError(f"{path}: expected a JSON object.")
    return decode_published(fields)


def _download(name: str) -> Path:
    """Return the local folder of a repository on the hub, fetched if it is not there yet."""
    try:
        from huggingface_hub import hf_hub_download, model_info
    except ModuleNotFoundError as error:
        raise TrilightError(
            f"checkpoint {name}: no such file or folder, and huggingface_hub, which would fetch "
            "it, is not installed. Run `make setup-all`, or name a local folder."
        ) from error
    reason = ""
    try:  # one short question: the downloads would ask again and again, for half a minute
        model_info(name, timeout=_ANSWER_S)
    except Exception as error:  # of whatever library asks
        reason = _first_line(error)
    try:
        hf_hub_download(name, CONFIG_NAME, local_files_only=bool(reason))
        path = hf_hub_download(name, WEIGHTS_NAME, local_files_only=bool(reason))
        return Path(path).parent
    except (OSError, ValueError) as error:
        raise TrilightError(
            f"checkpoint {name}: not on this machine, and the hub did not give it "
            f"({reason or _first_line(error)}). Check the name and the network, or name a local "
            "folder."
        ) from error


def _first_line(error: Exception) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__

"""Loads a pretrained network from any source, without pickle.

ours, shipped      builtin:hits (builtin: or default for short), builtin:tokens
our own            model.safetensors of `trilight train`, or the folder that holds one
checkpoints        a step of a run, or the folder of an unfinished run (train.loop.checkpoints)
published, local   a folder with config.json and model.safetensors
published, hub     microsoft/renderformer-v1-base, microsoft/renderformer-v1.1-swin-large
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor

from model.published import (
    PublishedConfig,
    decode_published_config,
    encode_published_config,
    export_published_weights,
    load_published_weights,
)
from model.renderformer import RenderFormer
from model.weights import (
    CONFIG_KEY,
    PUBLISHED_RANGE,
    RANGE_KEY,
    TrainedRange,
    decode_config,
    load_tensors,
    network_of,
    read_metadata,
    read_tensors,
)
from storage.aliases import NETWORKS, stored_name
from storage.atomic import write_atomically
from storage.digests import seal_of
from storage.errors import TrilightError, expected_one_of
from storage.records.safe_read import open_plain, read_plain, read_safetensors
from storage.typed_json import read_json

WEIGHTS_NAME = "model.safetensors"
CONFIG_NAME = "config.json"
"""File name of the configuration in the folder of a published checkpoint."""

PUBLISHED = ("microsoft/renderformer-v1-base", "microsoft/renderformer-v1.1-swin-large")
"""Names of the published checkpoints on the Hugging Face hub."""

_SHIPPED = Path(__file__).parent / "builtin"

BUILTIN = "builtin:"
"""Name of the better of the small networks that Trilight ships."""

BUILTIN_TOKENS = "builtin:tokens"
"""Name of the shipped network with RenderFormer's view stage, without traced inputs."""

BUILTIN_NETWORKS = {
    BUILTIN: _SHIPPED / "hits" / WEIGHTS_NAME,
    "builtin:hits": _SHIPPED / "hits" / WEIGHTS_NAME,
    BUILTIN_TOKENS: _SHIPPED / "tokens" / WEIGHTS_NAME,
}
"""File of each shipped network by name; its model card, README.md, is in the same folder."""

MAX_CONFIG_BYTES = 1 << 16
"""Maximum size of a config.json; published ones have about 1 KiB."""

_ANSWER_S = 5.0
"""Timeout of the hub's first response in seconds; afterwards cached files are used."""

_HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")
_PICKLES = (".pt", ".pth", ".bin", ".ckpt", ".pkl")


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkFile:
    """File of a network, whose weights are read when it is opened."""

    path: Path
    """Path of the file with the weights."""
    trained: TrainedRange
    """Range of the training data, as far as the file states it."""
    any_width: bool
    """True if pictures of other widths than in training are as good."""
    open: Callable[[], RenderFormer]
    """Returns the network, float32, in evaluation mode on the CPU; raises TrilightError if the file
    is damaged, or its tensors do not match its configuration."""


def open_network(source: str | Path) -> RenderFormer:
    """Return a network, float32, in evaluation mode on the CPU.

    Raises:
        TrilightError: no such file, pickled code, a damaged file, or tensors that do not match the
            configuration; the message lists their names.
    """
    return find_network(source).open()


def find_network(place: str | Path) -> NetworkFile:
    """Return the file of a network without reading its weights; published names are downloaded.

    Args:
        place: one of BUILTIN_NETWORKS, a file, a folder, or the name of a repository on the
            Hugging Face hub.

    Raises:
        TrilightError: no such file, pickled code, or a damaged checkpoint.
    """
    source = stored_name(str(place), NETWORKS)
    if source.startswith(BUILTIN) and source not in BUILTIN_NETWORKS:
        raise TrilightError(
            f"checkpoint {source}: no such network comes along; "
            f"{expected_one_of(source, sorted(BUILTIN_NETWORKS))}."
        )
    path = BUILTIN_NETWORKS.get(source, Path(source))
    is_finished = path.is_dir() and (path / WEIGHTS_NAME).is_file()
    if not is_finished and (checkpoint := find_checkpoint(path)):
        read = read_checkpoint(checkpoint)  # all of it: its digest verifies it
        settings = read.header.get("settings")
        width = settings.get("resolution") if isinstance(settings, dict) else None
        config = decode_config(read.header["model"], f"checkpoint {checkpoint}")
        return NetworkFile(
            path=checkpoint,
            trained=TrainedRange(resolution=width if isinstance(width, int) else None),
            any_width=config.traces_hits,
            open=read.network,
        )
    weights = _weights_file(source, path)
    metadata = read_metadata(weights)
    if CONFIG_KEY in metadata:
        config = decode_config(metadata[CONFIG_KEY], str(weights))
        return NetworkFile(
            path=weights,
            trained=read_json(metadata.get(RANGE_KEY, "{}"), TrainedRange, RANGE_KEY),
            any_width=config.traces_hits,
            open=lambda: network_of(config, read_tensors(weights)[0]),
        )
    return NetworkFile(
        path=weights,
        trained=PUBLISHED_RANGE,
        any_width=False,
        open=lambda: load_published_weights(
            read_tensors(weights)[0], _read_config(weights.parent / CONFIG_NAME)
        ),
    )


def _weights_file(source: str, path: Path) -> Path:
    """Return the safetensors file of a source; raises as `find_network`."""
    if not path.exists():
        is_path = path.suffix in (*_PICKLES, ".safetensors") or source.startswith("runs/")
        if is_path or not _HUB_NAME.fullmatch(source):
            raise TrilightError(
                f"checkpoint {source}: no such file or folder; expected one, default (the included "
                f"network), or a published name such as {PUBLISHED[0]}."
            )
        path = _download(source)
    weights = path / WEIGHTS_NAME if path.is_dir() else path
    has_pickles = path.is_dir() and any(each.suffix in _PICKLES for each in path.iterdir())
    if path.is_dir() and not weights.exists() and not has_pickles:
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


def save_published(model: RenderFormer, folder: Path) -> None:
    """Write a network as a published checkpoint: config.json and model.safetensors.

    Its texture input is as wide as that of its family, as the published loader expects. A network
    that was trained here has its registers at the exact mean of the triangles; the published code
    puts them 1e-5 / T nearer to the origin.

    Raises:
        TrilightError: the network is of neither published family, or the folder cannot be written.
    """
    texture_patch = 1 if model.config.window_bundles else 32
    text = json.dumps(encode_published_config((model.config, texture_patch)), indent=2)
    tensors = {
        name: x.contiguous() for name, x in export_published_weights(model, texture_patch).items()
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / WEIGHTS_NAME, save(tensors, metadata={"format": "pt"}))
    write_atomically(folder / CONFIG_NAME, text.encode())


def _read_config(path: Path) -> PublishedConfig:
    try:
        with open_plain(path) as file:
            data = file.read(MAX_CONFIG_BYTES)
    except OSError as error:
        raise TrilightError(
            f"{path}: cannot be read ({error.strerror}); weights that carry no configuration of "
            "ours need the published one beside them."
        ) from error
    text = data.decode(json.detect_encoding(data), "replace")  # editors add byte order marks
    return decode_published_config(read_json(text, dict[str, Any], str(path)))


def _download(name: str) -> Path:
    """Return the local folder of a repository on the hub, after a download if necessary."""
    try:
        from huggingface_hub import hf_hub_download, model_info
    except ModuleNotFoundError as error:
        raise TrilightError(
            f"checkpoint {name}: no such file or folder, and huggingface_hub, which would fetch "
            "it, is not installed. Run `make setup-all`, or name a local folder."
        ) from error
    reason = ""
    try:  # one short request first: downloads would retry for half a minute
        model_info(name, timeout=_ANSWER_S)
    except Exception as error:  # the hub's HTTP library is not known
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


FOLDER_NAME = "checkpoints"
"""Name of the folder of the checkpoints in the folder of a run."""

PREFIX = "step-"
SUFFIX = ".safetensors"
"""Suffix of the file names, after the number of the step."""

HEADER_KEY = "trilight_checkpoint"
"""Metadata entry with counters, damaged samples, settings, digest of the data, the mixture, the
history, and the execution: number of processes and threads, precision of Muon's products."""

_SHA256 = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Checkpoint:
    """Header and tensors of a checkpoint file."""

    header: Mapping[str, Any]
    """Step, settings, digest of the data, history, number of processes."""
    arrays: Mapping[str, NDArray]
    """Tensors by part and name."""

    def network(self) -> RenderFormer:
        """Return the network that was evaluated at that step: the EMA if there is one."""
        model = RenderFormer(decode_config(self.header["model"]))
        load_tensors(model, self.tensors_under("mean") or self.tensors_under("model"))
        return model.eval()

    def tensors_under(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors of a part, by their names in it."""
        start = f"{prefix}/"
        return {
            name.removeprefix(start): torch.from_numpy(array)
            for name, array in self.arrays.items()
            if name.startswith(start)
        }


def saved_steps(folder: Path) -> list[int]:
    """Return the steps of the saved checkpoints, oldest first."""
    names = [path.name for path in folder.glob(f"{PREFIX}*{SUFFIX}")]
    digits = [name.removeprefix(PREFIX).removesuffix(SUFFIX) for name in names]
    return sorted(int(text) for text in digits if text.isdecimal())


def path_of_step(folder: Path, step: int) -> Path:
    """Return the path of the checkpoint of a step."""
    return folder / f"{PREFIX}{step:09d}{SUFFIX}"


def find_checkpoint(path: Path) -> Path | None:
    """Return the path of a checkpoint, or of the newest one in the folder of a run; else None."""
    if path.is_dir():
        steps = saved_steps(path / FOLDER_NAME)
        if not steps:
            return None
        path = path_of_step(path / FOLDER_NAME, steps[-1])
    if path.suffix != SUFFIX or not path.is_file():
        return None
    return path if HEADER_KEY in read_metadata(path) else None


def read_header(path: Path) -> dict[str, Any]:
    """Return the header of a checkpoint without its tensors, unverified."""
    return dict(json.loads(read_metadata(path)[HEADER_KEY]))


def read_checkpoint(path: Path, header_type: type | None = None) -> Checkpoint:
    """Read a checkpoint and verify its bytes and weights.

    Args:
        header_type: type that the header must have in full, if the whole state is restored.

    Raises:
        TrilightError: no checkpoint, another header or other bytes than were written, or weights
            that are no finite float32 numbers; the message has the path.
    """
    try:
        data = read_plain(path)
        arrays, metadata = read_safetensors(data)
        if HEADER_KEY not in metadata:
            raise TrilightError("it belongs to no run; expected one that `trilight train` wrote")
        header = json.loads(metadata[HEADER_KEY])
        if not isinstance(header, dict) or not isinstance(header.get("model"), str):
            raise TrilightError("its header has no configuration of a network")
        seal = header.get("sha256")  # old checkpoints have none
        is_seal = isinstance(seal, str) and _SHA256.fullmatch(seal)
        if seal and not (is_seal and seal_of(data, seal) == seal):
            raise TrilightError("its bytes are not those that were written")
        for name, array in arrays.items():
            is_weight = name.startswith(("model/", "mean/"))
            if is_weight and not (array.dtype == np.float32 and np.isfinite(array).all()):
                raise TrilightError(f"{name} is {array.dtype}; expected finite float32 numbers")
        if header_type is not None:
            read_json(metadata[HEADER_KEY], header_type, "its header")
    except (OSError, ValueError, RecursionError) as error:
        reason = str(error).rstrip(".")
        raise TrilightError(f"checkpoint {path} is not readable: {reason}.") from error
    return Checkpoint(header=header, arrays=arrays)

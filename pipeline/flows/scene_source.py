"""What `SRC` means where a command wants one scene: a file of its own, or a sample of a shard.

    scene.json                 RenderFormer scene; its meshes lie in the folder of the file
    scene.safetensors          storage.scene_file
    scene.h5                   the published layout (storage.renderformer_h5)
    train-000000.tar::KEY      the sample KEY of a shard

The last form is taken apart here and nowhere else: no library that knows URLs ever sees it.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from pipeline.assets.settings import AssetSettings
from pipeline.flows.scene_files import build_scene, described_by
from pipeline.objects.licences import USER_PROVIDED
from storage.errors import TrilightError
from storage.profiles import PACKED, PLAIN
from storage.renderformer_h5_read import read_renderformer_h5
from storage.safe_url import safe_url
from storage.sample import decode_scene
from storage.scene import Scene
from storage.scene_file import read_scene_file
from storage.shard_reader import read_members

SEPARATOR = "::"
"""Between a shard and the key of a sample."""

_KEY = re.compile(r"[0-9A-Za-z_\-]+")
_EXPECTED = "expected a scene .json, .safetensors or .h5, or SHARD.tar::KEY"
_MEMBERS = ("json", PLAIN, PACKED)


@dataclass(frozen=True, kw_only=True)
class SceneSource:
    """Where one scene is."""

    path: Path
    """The file."""
    key: str | None
    """The sample in it, where it is a shard."""

    @property
    def name(self) -> str:
        """What may be published: the file without its folders, and the key."""
        return self.path.name if self.key is None else f"{self.path.name}{SEPARATOR}{self.key}"


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedScene:
    """A scene as it was read."""

    scene: Scene
    """It passes `Scene.check`."""
    notes: tuple[str, ...]
    """What a person should know: what of a file means nothing, or could not be carried over."""


def scene_source(text: str) -> SceneSource:
    """Return what the user's `SRC` names; the file is not opened yet.

    Raises:
        TrilightError: a URL, no such file, or a name that is none of the three forms.
    """
    if "://" in text:
        raise TrilightError(f"{safe_url(text)}: only files of this machine are read; {_EXPECTED}.")
    name, separator, key = text.rpartition(SEPARATOR)
    path = Path(name if separator else text)
    suffix = path.suffix.lower()
    if separator and (suffix != ".tar" or not _KEY.fullmatch(key)):
        raise TrilightError(f"{text}: no shard and key; {_EXPECTED}.")
    if path.is_dir():
        raise TrilightError(f"{text}: a folder; {_EXPECTED}.")
    if not path.exists():
        raise TrilightError(f"{text}: no such file; {_EXPECTED}.")
    if not separator and suffix == ".tar":
        raise TrilightError(f"{text}: a shard holds many scenes; expected {text}{SEPARATOR}KEY.")
    if not separator and suffix not in (".json", ".safetensors", ".h5"):
        raise TrilightError(f"{text}: cannot be read as a scene; {_EXPECTED}.")
    return SceneSource(path=path, key=key if separator else None)


def load_source(source: SceneSource) -> LoadedScene:
    """Read a scene, with all of its cameras; only children come here, since meshes may be read.

    Raises:
        TrilightError: anything in the file is unusable, or breaks a law of scenes.
    """
    if source.key is not None:
        members = read_members(source.path, source.key, _MEMBERS)
        scene = decode_scene(source.key, members).scene
        try:
            scene.check()
        except TrilightError as error:
            raise TrilightError(f"sample {source.key}: {error}") from error
        return LoadedScene(scene=scene, notes=())
    if source.path.suffix.lower() == ".safetensors":
        return LoadedScene(scene=read_scene_file(source.path), notes=())
    root, name = source.path.parent.resolve(), source.path.name
    if source.path.suffix.lower() == ".h5":
        found = read_renderformer_h5(source.path)
        return LoadedScene(scene=found.scene, notes=tuple(f"{name}: {text}" for text in found.lost))
    unknown = described_by(root, name).unknown_fields
    scene, _ = build_scene(
        root,
        name,
        AssetSettings(),
        licence=USER_PROVIDED,
        num_views=None,
        scene_index=0,
        seed=0,
    )
    return LoadedScene(scene=scene, notes=tuple(f"{name}: unknown field {f}" for f in unknown))

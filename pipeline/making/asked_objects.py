"""What is asked for where the objects of a dataset are frozen."""

from dataclasses import dataclass

from pipeline.builds.settings import BuildSettings
from pipeline.making.accept_maps import NO_FOLDERS, MapFolders
from pipeline.making.frozen_pool import FrozenPool
from pipeline.making.publication import Publication
from pipeline.objects.sources import ListedObjects, list_objects
from storage.digests import canonical_json, sha256_hex


@dataclass(frozen=True, kw_only=True, eq=False)
class AskedObjects:
    """The objects of a dataset, as they are asked for."""

    source: str
    """Where they come from, as `find_objects` takes it; may hold a secret."""
    licence: str | None
    """Of files without a statement, as the user states it."""
    settings: BuildSettings
    """The build, which says how objects are prepared and dealt to splits."""
    publication: Publication
    """The dataset."""
    workers: int
    """Objects at a time."""
    own: MapFolders = NO_FOLDERS
    """Folders of textures and maps, which are frozen with the objects."""

    @property
    def digest(self) -> str:
        """Of what the source is asked for: another source is looked at again."""
        return sha256_hex(canonical_json([self.source, self.licence]))

    @property
    def pool(self) -> FrozenPool:
        """Where scenes, once the objects are frozen, have them from."""
        folder = self.publication.folder
        return FrozenPool(
            lock=folder.objects_lock,
            index=folder.staged_index,
            source=self.source,
            licence=self.licence,
        )

    def listed(self) -> ListedObjects:
        """List the source; raises as `list_objects`."""
        return list_objects(
            self.source,
            work_dir=self.publication.folder.staged_objects,
            allowed_licences=self.settings.allowed_licences,
            licence=self.licence,
        )

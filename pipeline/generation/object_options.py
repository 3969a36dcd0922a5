"""`ObjectOptions`: source, licences and settings of the objects to freeze."""

from dataclasses import dataclass

from pipeline.builds.settings import BuildSettings
from pipeline.generation.accept_maps import NO_FOLDERS, MapFolders
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.frozen_pool import FrozenPool
from pipeline.objects.sources import ListedObjects, list_objects
from storage.digests import canonical_json, sha256_hex


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectOptions:
    """Source and settings of a dataset's objects."""

    source: str
    """Source of the objects, as `find_objects` takes it; may hold a secret."""
    licence: str | None
    """Licence that the user states for files without one."""
    settings: BuildSettings
    """Settings of the build: how objects are prepared and assigned to splits."""
    writer: DatasetWriter
    """Writer of the dataset that the objects are frozen for."""
    workers: int
    """Number of objects that are prepared at the same time."""
    user_folders: MapFolders = NO_FOLDERS
    """Folders of textures and maps, which are frozen with the objects."""

    @property
    def digest(self) -> str:
        """Digest of source and licence: with another one, every object is checked again."""
        return sha256_hex(canonical_json([self.source, self.licence]))

    @property
    def pool(self) -> FrozenPool:
        """The pool from which scenes draw objects once these are frozen."""
        folder = self.writer.folder
        return FrozenPool(
            lock=folder.objects_lock,
            index=folder.staged_index,
            source=self.source,
            licence=self.licence,
        )

    def list_source(self) -> ListedObjects:
        """List the source; raises as `list_objects`."""
        return list_objects(
            self.source,
            work_dir=self.writer.folder.staged_objects,
            allowed_licences=self.settings.allowed_licences,
            licence=self.licence,
        )

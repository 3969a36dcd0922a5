"""The stage, run on a bench, and what came of it."""

from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import PreparedAsset, prepare_assets
from pipeline.assets.store import AssetStore
from storage.records.asset import Asset, decode_asset
from storage.records.objects import Failure
from tests.pipeline.assets.child_kit import Bench

FIRST, SECOND, THIRD = "pymeshlab_collapse", "meshoptimizer", "meshoptimizer_sloppy"
SETTINGS = AssetSettings(budgets=(1000, 500, 340))


def run(
    bench: Bench, *names: str, settings: AssetSettings = SETTINGS, store: str = "store"
) -> tuple[list[PreparedAsset], list[Failure]]:
    """Prepare objects with a store beside the sources."""
    return prepare_assets(
        [bench.record(name) for name in names],
        settings,
        AssetStore(bench.root.parent / store),
        borrow_child=bench.borrow,
        workers=1,
        done=lambda: None,
    )


def made(bench: Bench, settings: AssetSettings = SETTINGS) -> Asset:
    (prepared,), failures = run(bench, "knot.obj", settings=settings)
    assert not failures
    return decode_asset(prepared.path.read_bytes())


def methods(asset: Asset) -> list[tuple[int, str]]:
    return [(level.record.budget, level.record.method) for level in asset.levels]

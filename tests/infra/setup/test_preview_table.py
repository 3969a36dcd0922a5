"""The shipped table is of medians of scenes; only the probes of other machines are means."""

from infra.rendering.machine_costs import PROBES
from infra.rendering.way_table import shipped_table
from infra.setup.preview_table import NETWORK, WIDTHS, ladder, part_names, table_of


def test_scenes_become_medians_and_probes_means() -> None:
    methods = {px: (NETWORK, *ladder(px)) for px in WIDTHS}
    errors = {
        scene: {
            px: {method: 20.0 + row + 10 * scene for row, method in enumerate(methods[px])}
            for px in WIDTHS
        }
        for scene in (0, *PROBES)
    }
    costs = {
        scene: {px: dict.fromkeys(part_names(), float(spent)) for px in WIDTHS}
        for scene, spent in zip((0, *PROBES), (1, 2, 6), strict=True)
    }
    table = table_of(errors, costs, "some processor, one thread")
    assert (table.scenes, table.costs.machine) == (3, "some processor, one thread")
    first = table.errors[0]
    assert (first.rung, first.median_db, first.least_db) == ("network", 30.0, 20.0)
    assert len(table.errors) == sum(map(len, methods.values()))
    for row, probe in zip(table.costs.rows, table.probe.rows, strict=True):
        assert (row.part, row.width) == (probe.part, probe.width)
        assert row.serial_s + row.parallel_s == 2.0
        assert probe.serial_s + probe.parallel_s == 4.0
        assert (row.parallel_s == 0) == (row.part == "scene")


def test_what_is_shipped_has_the_rows_that_this_makes() -> None:
    shipped = shipped_table()
    assert [(row.width, row.spp, row.denoiser) for row in shipped.errors] == [
        (px, *method) for px in WIDTHS for method in (NETWORK, *ladder(px))
    ]
    wanted = [(part, px) for px in WIDTHS for part in part_names()]
    assert [(row.part, row.width) for row in shipped.costs.rows] == wanted

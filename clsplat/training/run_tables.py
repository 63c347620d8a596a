"""The tables of a run in its checkpoint: those of a field, or of Gaussians, what is behind them, and the best model."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from clsplat.density.statistics import FOLDER as STATS_FOLDER
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.errors import DataError
from clsplat.gaussians.tables import Gaussians
from clsplat.training import colour_grids, kept, own_gaussians, sky, trained_field
from clsplat.training.adam import Adam
from clsplat.training.archive import Arrays, split
from clsplat.training.kept_tables import restore_sky
from clsplat.training.placing import make_room
from clsplat.training.run import Run
from clsplat.training.state import State, check_tables

UPDATES = "field"  # name of their number


def tables_of(run: Run) -> Iterator[tuple[str, NDArray[np.float32]]]:
    """Yield the tables by their keys in the file, each copied to the host when it is its turn."""
    if run.learned_field:
        yield from ((trained_field.FOLDER + name, table) for name, table in run.learned_field.tables().items())
        return
    gaussians = run.model.gaussians
    yield from ((_key(name), gaussians.get(name)) for name in gaussians.tables)
    yield from ((sky.FOLDER + name, table) for name, table in (run.sky.tables() if run.sky else {}).items())
    of_colours = run.colour_grids.tables() if run.colour_grids else {}
    yield from ((colour_grids.FOLDER + name, table) for name, table in of_colours.items())
    of_photographs = run.distractors.tables() if run.distractors else {}
    yield from ((own_gaussians.FOLDER + name, table) for name, table in of_photographs.items())
    yield from ((kept.FOLDER + name, table) for name, table in run.best_tables.items())


def updates_of(run: Run) -> dict[str, int]:
    """Return how often Adam has updated each of its tables."""
    if run.learned_field:
        return {UPDATES: run.learned_field.updates}
    return run.adam.updates if run.adam else {}


def check(state: State, tables: Arrays) -> None:
    """Raise DataError for tables that are not those of the state."""
    if state.field:
        if state.updates.keys() != {UPDATES}:
            raise DataError("it counts updates of other parameters than those of its field")
        kind = trained_field.kind_of(state.field)
        kind.check_tables(state.field["shape"], *split(tables, trained_field.FOLDER))
        return
    best, own = split(tables, kept.FOLDER)
    kept.check(state.best, best)
    behind, own = split(own, sky.FOLDER)
    sky.check_tables(behind)
    of_colours, own = split(own, colour_grids.FOLDER)
    colour_grids.check_tables(of_colours)
    colour_grids.require_tables(of_colours, state.numbers)
    of_photographs, own = split(own, own_gaussians.FOLDER)
    own_gaussians.check_tables(of_photographs)
    check_tables(state, {name.removeprefix("gaussians/"): table for name, table in own.items()})


def restore(run: Run, state: State, tables: Arrays) -> None:
    """Put the tables of a state into a run."""
    if state.field:
        own, _ = split(tables, trained_field.FOLDER)
        kind = trained_field.kind_of(state.field)
        run.learned_field = kind.of_tables(state.field["shape"], own, run.photographs.background)
        run.learned_field.updates = state.updates[UPDATES]
        return
    run.best_tables, tables = split(tables, kept.FOLDER)
    behind, tables = split(tables, sky.FOLDER)
    of_colours, tables = split(tables, colour_grids.FOLDER)
    run.colour_grids = colour_grids.restored(of_colours, run.device)
    of_photographs, tables = split(tables, own_gaussians.FOLDER)
    run.distractors = own_gaussians.restored(of_photographs, run.device)
    gaussians = Gaussians(run.device, {name.removeprefix("gaussians/"): table for name, table in tables.items()})
    run.model = run.model_settings.model(gaussians, state.degree)
    if state.updates:
        make_room(run, gaussians.count)
        run.adam = Adam(gaussians)
        run.adam.updates = state.updates
        columns = [name for name in tables if name.startswith(STATS_FOLDER) and name != SEEN]
        run.stats = SplatStats(gaussians, [name.removeprefix(STATS_FOLDER) for name in columns])
    for key, table in tables.items():  # those of rules, penalties and plug-ins too
        name = key.removeprefix("gaussians/")
        if name not in gaussians.tables:
            gaussians.add(name, table.shape[1], zero_fresh=name in state.zero_fresh)
        gaussians.set(name, table)
    restore_sky(run, behind)


def _key(table: str) -> str:
    """The key of a table in the file: parameters are in the folder `gaussians`."""
    return table if "/" in table else f"gaussians/{table}"

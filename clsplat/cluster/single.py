"""One cell by itself: what `sbatch --array` calls, and any other queue."""

import logging
import threading
from collections.abc import Sequence
from pathlib import Path

from clsplat.cluster.batch import ask_to_stop, wanted_cell
from clsplat.cluster.child import run_command
from clsplat.cluster.fingerprint import Scenes
from clsplat.cluster.plugin_files import plugin_files
from clsplat.cluster.probe import places
from clsplat.cluster.store import Store
from clsplat.cluster.task import Terms, run_cell
from clsplat.errors import ClsplatError, ConfigError, Interrupted
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import Cell as MatrixCell
from clsplat.pipeline.matrix import Experiment, load_experiment
from clsplat.signals import stopping_on_signals

LOG = logging.getLogger("clsplat")


def run_one(
    pipeline: str,
    root: Path,
    overrides: Sequence[str] = (),
    index: int | None = None,
    device: str | None = None,
    retries: int = 3,
) -> Path:
    """Run one cell of a matrix, or a pipeline as a cell, unless its result is in the store; return its folder.

    index: of the cell in the matrix, from 0.  Raises ClsplatError with the exit code of its run.
    """
    experiment = load_experiment(pipeline, overrides)
    if experiment is None:
        if index:
            raise ConfigError(f"{pipeline}: is a single pipeline, which has no cell {index}; leave --index out")
        checked = load(pipeline, list(overrides))
        cells = [MatrixCell(checked.settings.name, checked)]
        experiment = Experiment(checked.path, checked.settings.name, "", cells)
    elif index is None or not 0 <= index < len(experiment.cells):
        last = len(experiment.cells) - 1
        raise ConfigError(f"{pipeline}: is a matrix; expected --index from 0 to {last}, the number of a cell")
    chosen = experiment.cells[index or 0]
    store, stop, driving = Store(root), threading.Event(), threading.Event()
    with stopping_on_signals(lambda: ask_to_stop(stop, driving)):
        terms = Terms(store.now(), retries, "cell")
        wanted = wanted_cell(chosen, Scenes(store.scenes), store)
        (place,) = places("cell", [device or ""])
        cell = wanted.on(place.bits)
        store.note_sweep(f"{experiment.name}-{cell.name}", {cell.name: cell.key}, cell.key)
        driving.set()
        outcome = run_cell(cell, store, run_command(place.device, plugin_files()), terms, stop.is_set)
    if outcome.state == "stopped":
        raise Interrupted(f"cell {cell.name}: {outcome.message}; the same command goes on with it")
    if outcome.state != "published":
        error = ClsplatError(f"cell {cell.name}: {outcome.message}")
        error.exit_code = outcome.exit_code
        raise error
    result = store.folder(cell.key).result
    LOG.info("cell %s: published in %s", cell.name, result)
    return result

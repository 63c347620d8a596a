"""Save and restore a run, bit for bit: parameters, Adam's moments, statistics and counters, without pickle.

Random numbers and the order of views depend on (seed, step) alone, so the step is their state.
"""

import json
import logging
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat import __version__
from clsplat.density.statistics import FOLDER as STATS_FOLDER
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.errors import ConfigError, DataError
from clsplat.files import atomic
from clsplat.gaussians.tables import PARAMETERS, Gaussians
from clsplat.training.adam import Adam
from clsplat.training.run import Run

FORMAT = 3
FOLDER = "checkpoints"
LOG = logging.getLogger("clsplat")
Tables = dict[str, NDArray[np.float32]]


def save(run: Run, keep: int) -> Path:
    """Write checkpoints/step_N.npz, whole or not at all, and remove all but the `keep` newest."""
    model = run.model
    tables = {_key(name): model.gaussians.get(name) for name in model.gaussians.tables}
    meta = {
        "format": FORMAT,
        "version": __version__,
        "step": run.step,
        "cursor": run.cursor,
        "stage_step": run.stage_step,
        "degree": model.degree,
        "zero_fresh": [name for name, table in model.gaussians.tables.items() if table.zero_fresh],
        "updates": run.adam.updates if run.adam else {},
        "train_seconds": run.train_seconds,
        "metrics": run.metrics,
        "device": run.device.text,
        "pipeline": run.pipeline,
    }
    folder = run.out / FOLDER
    path = folder / f"step_{run.step:06d}.npz"
    with atomic(path) as file:
        np.savez(file, allow_pickle=False, meta=np.array(json.dumps(meta)), **tables)
    for old in _saved(folder)[:-keep]:
        old.unlink(missing_ok=True)
    return path


def restore(run: Run) -> bool:
    """Restore the newest checkpoint that is not damaged; return False when there is none.

    Raises ConfigError when the checkpoint was made by a pipeline with other settings.
    """
    for path in reversed(_saved(run.out / FOLDER)):
        try:
            meta, tables = _load(path)
        except (OSError, ValueError, KeyError, zipfile.BadZipFile, DataError) as error:
            LOG.warning("%s is damaged (%s); using the one before it", path, error)
            continue
        difference = first_difference(meta["pipeline"], run.pipeline)
        if difference:
            raise ConfigError(
                f"{path} was made with other settings: {difference}; use another --out, or those settings"
            )
        if meta["device"] != run.device.text:
            LOG.warning("the run was started on %s: the bits may differ from here on", meta["device"])
        _restore(run, meta, tables)
        return True
    return False


def _saved(folder: Path) -> list[Path]:
    """Checkpoints from old to new."""
    return sorted(path for path in folder.glob("step_*.npz") if re.fullmatch(r"step_\d+\.npz", path.name))


def _load(path: Path) -> tuple[dict[str, Any], Tables]:
    with np.load(path, allow_pickle=False) as archive:
        meta = json.loads(str(archive["meta"]))
        tables = {name: archive[name] for name in archive.files if name != "meta"}
    if meta["format"] != FORMAT:
        raise ConfigError(
            f"{path} has format {meta['format']}, expected {FORMAT}: clsplat {meta['version']} made it before the "
            "format changed; go on with the program that made it, or use another --out"
        )
    missing = [name for name in PARAMETERS if _key(name) not in tables]
    if missing:
        raise DataError(f"lacks {', '.join(missing)}")
    return meta, tables


def _restore(run: Run, meta: dict[str, Any], tables: Tables) -> None:
    gaussians = Gaussians(run.device, {name.removeprefix("gaussians/"): table for name, table in tables.items()})
    run.model = run.model_settings.model(gaussians, meta["degree"])
    if meta["updates"]:
        run.adam = Adam(gaussians)
        run.adam.updates = meta["updates"]
        columns = [name for name in tables if name.startswith(STATS_FOLDER) and name != SEEN]
        run.stats = SplatStats(gaussians, [name.removeprefix(STATS_FOLDER) for name in columns])
    for key, table in tables.items():  # those of rules, penalties and plug-ins too
        name = key.removeprefix("gaussians/")
        if name not in gaussians.tables:
            gaussians.add(name, table.shape[1], zero_fresh=name in meta["zero_fresh"])
        gaussians.set(name, table)
    run.step, run.cursor, run.stage_step = meta["step"], meta["cursor"], meta["stage_step"]
    run.train_seconds, run.metrics = meta["train_seconds"], meta["metrics"]


def _key(table: str) -> str:
    """The key of a table in the file: parameters are in the folder `gaussians`."""
    return table if "/" in table else f"gaussians/{table}"


def first_difference(old: Any, new: Any, place: str = "") -> str | None:
    """Return the first setting in which two resolved pipelines differ, or None."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(k for k in new if k not in old)]:
            difference = first_difference(old.get(key), new.get(key), f"{place}.{key}" if place else str(key))
            if difference:
                return difference
        return None
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        pairs = enumerate(zip(old, new, strict=True))
        return next((d for i, (a, b) in pairs if (d := first_difference(a, b, f"{place}[{i}]"))), None)
    return None if old == new else f"{place} was {old!r}, is {new!r}"

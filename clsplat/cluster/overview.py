"""The state of a store, from its files alone."""

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from clsplat.cluster.attempt import Attempt
from clsplat.cluster.folder import SILENT, SPEC, CellFolder
from clsplat.cluster.store import CELLS, Store
from clsplat.errors import DataError, one_line
from clsplat.reading import read_json
from clsplat.training.status import read_status

GONE = 60.0  # seconds without a beat after which a run may have ended


def is_store(folder: Path) -> bool:
    """Whether a folder holds a store."""
    return (folder / CELLS).is_dir()


def store_status(root: Path) -> dict[str, Any]:
    """Return the `cells` of a store with their states, `counts` of those, and `events` by kind.

    State of a cell: published, failed, running, silent (its lease has no beat for a minute), stopped, or waiting.
    Raises DataError when the folder holds no store.
    """
    store = Store.opened(root)
    now = time.time()
    names = {key: name for cells in store.sweeps() for name, key in cells.items()}
    cells = [_cell(folder, names.get(folder.key, ""), now) for folder in store.folders()]
    counts: dict[str, int] = {}
    for cell in cells:
        counts[cell["state"]] = counts.get(cell["state"], 0) + 1
    events: dict[str, int] = {}
    for event in store.events():
        events[str(event.get("event"))] = events.get(str(event.get("event")), 0) + 1
    return {"store": str(root), "counts": counts, "events": events, "cells": cells}


def _cell(folder: CellFolder, name: str, now: float) -> dict[str, Any]:
    spec: Any = {}
    with suppress(DataError):
        spec = read_json(folder.path / SPEC)
    spec = spec if isinstance(spec, dict) and isinstance(spec.get("pipeline"), dict) else {"pipeline": {}}  # damaged
    pipeline = spec["pipeline"]
    found = {"key": folder.key, "name": name, "pipeline": pipeline.get("name"), "seed": pipeline.get("seed")}
    found |= {"bits": spec.get("bits")}
    if manifest := folder.manifest():
        return {**found, "state": "published", **{key: manifest.get(key) for key in ("seconds", "device", "worker")}}
    attempts = sorted(folder.attempts(), key=lambda attempt: attempt.beaten)
    alive = [one for one in attempts if one.exit_code is None and now - one.beaten < GONE]
    if (failed := folder.failed()) and not alive:
        return {**found, "state": "failed", "message": failed.get("message"), "exit_code": failed.get("exit_code")}
    last = (alive or attempts)[-1:]
    return {**found, "attempts": len(attempts), **(_attempt(last[0], now) if last else {"state": "waiting"})}


def _attempt(attempt: Attempt, now: float) -> dict[str, Any]:
    """The state of a cell by its last attempt."""
    status = read_status(attempt.path)
    silent = now - attempt.beaten
    if attempt.exit_code is not None:
        state = "stopped" if attempt.exit_code == 130 else "waiting"
    else:
        state = "running" if silent < GONE else "silent"
    progress = {key: status.get(key) for key in ("step", "steps", "seconds_left", "stage")}
    worker = {key: attempt.lease.get(key) for key in ("host", "worker")}
    return {"state": state, "silent": round(max(0.0, silent)), **progress, **worker}


def overview_text(found: dict[str, Any]) -> str:
    """Return what `store_status` found as lines of text, a cell a line."""
    counts = ", ".join(f"{count} {state}" for state, count in sorted(found["counts"].items())) or "no cells"
    lines = [f"{found['store']}: {counts}"]
    for cell in found["cells"]:
        name = cell["name"] or f"{cell['pipeline']} seed={cell['seed']}"
        lines.append(f"{cell['key']}  {cell['state']:9}  {name}{_detail(cell)}")
    return "\n  ".join(map(one_line, lines))


def _detail(cell: dict[str, Any]) -> str:
    if cell["state"] == "published":
        return f", {cell['seconds']:.0f} s" if isinstance(cell.get("seconds"), int | float) else ""
    if cell["state"] == "failed":
        return f": {cell['message']}"
    step = f", step {cell['step']}/{cell.get('steps')}" if cell.get("step") is not None else ""
    more = ""
    if cell["state"] == "silent":
        waits = "; it goes on when its sweep is run again" if cell["silent"] > SILENT else ""
        more = f", no sign of life for {cell['silent']} s on {cell.get('host')}{waits}"
    return step + more

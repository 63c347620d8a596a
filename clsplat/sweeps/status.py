"""Report the state of a store from its files."""

import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from clsplat.core.errors import DataError, one_line
from clsplat.core.files import METRICS
from clsplat.core.reading import read_json
from clsplat.runs.results import read_metrics
from clsplat.sweeps.store import CELLS, SPEC, STALE_AFTER_S, CellAttempt, CellFolder, Store, finite_number
from clsplat.training.status import read_status

NO_BEAT_S = 60.0  # seconds without a heartbeat after which a run may have ended


def is_store(folder: Path) -> bool:
    """Return whether a folder is a store."""
    return (folder / CELLS).is_dir()


def store_status(root: Path) -> dict[str, Any]:
    """Return the `cells` of a store with their states, the number of cells in each state, and other totals.

    A cell is published, failed, running, silent (no heartbeat for a minute), stopped, or waiting.  Other keys: `store`,
    `time` (now), `counts` (cells by state), and `events` (counts by kind).  Raises DataError if the folder is not a
    store.
    """
    store = Store.open(root)
    now = time.time()
    names = {key: (sweep, name) for sweep, cells in store.sweeps() for name, key in cells.items()}
    cells = [_cell_status(folder, names.get(folder.key, ("", "")), now) for folder in store.folders()]
    cells.sort(key=lambda cell: (cell["sweep"], cell["name"], cell["key"]))
    counts: dict[str, int] = {}
    for cell in cells:
        counts[cell["state"]] = counts.get(cell["state"], 0) + 1
    events: dict[str, int] = {}
    for event in store.events():
        events[str(event.get("event"))] = events.get(str(event.get("event")), 0) + 1
    return {"store": str(root), "time": now, "counts": counts, "events": events, "cells": cells}


def _cell_status(folder: CellFolder, names: tuple[str, str], now: float) -> dict[str, Any]:
    """Return the state of a cell.  names: the name of its sweep, and the name of the cell in that sweep."""
    spec: Any = {}
    with suppress(DataError):
        spec = read_json(folder.path / SPEC)
    spec = spec if isinstance(spec, dict) and isinstance(spec.get("pipeline"), dict) else {"pipeline": {}}  # damaged
    pipeline = spec["pipeline"]
    fields = {"key": folder.key, "sweep": names[0], "name": names[1], "bits": spec.get("bits")}
    fields |= {"pipeline": pipeline.get("name"), "seed": pipeline.get("seed"), "steps": _steps(pipeline)}
    if manifest := folder.manifest():
        result = {key: manifest.get(key) for key in ("device", "host", "worker")}
        result["seconds"] = finite_number(manifest.get("seconds"))
        return {**fields, "state": "published", **result, **_result_metrics(folder)}
    attempts = sorted(folder.attempts(), key=lambda attempt: attempt.last_beat)
    live_attempts = [item for item in attempts if item.exit_code is None and now - item.last_beat < NO_BEAT_S]
    if (failure := folder.failure()) and not live_attempts:
        return {**fields, "state": "failed", "message": failure.get("message"), "exit_code": failure.get("exit_code")}
    latest = (live_attempts or attempts)[-1:]
    return {**fields, "attempts": len(attempts), **(_attempt_state(latest[0], now) if latest else {"state": "waiting"})}


def _steps(pipeline: dict[str, Any]) -> int | None:
    """Return the total number of training steps of a resolved pipeline; None if the pipeline is damaged."""
    with suppress(KeyError, TypeError, AttributeError, ValueError, OverflowError):
        return int(sum(settings.get("steps", 0) for stage in pipeline["stages"] for settings in stage.values()))
    return None


def _result_metrics(folder: CellFolder) -> dict[str, Any]:
    """Return the PSNR, the SSIM, and the numbers of steps and Gaussians of a result; empty if they cannot be read.

    PSNR and SSIM are means over the test views, or the training views if there are none, at the first downscale factor.
    """
    with suppress(DataError):
        metrics = read_metrics(folder.result / METRICS)
        averages = [*metrics.test.values(), *metrics.train.values()]
        quality = {"psnr": averages[0].psnr, "ssim": averages[0].ssim} if averages else {}
        return {**quality, "step": metrics.steps, "gaussians": metrics.gaussians}
    return {}


def _attempt_state(attempt: CellAttempt, now: float) -> dict[str, Any]:
    """Return the state of a cell, from its last attempt."""
    status = read_status(attempt.path)
    silence = now - attempt.last_beat
    failure = {"message": attempt.message(attempt.exit_code)} if attempt.has_failed and attempt.exit_code else {}
    if attempt.exit_code is not None:
        state = "stopped" if attempt.exit_code == 130 else "waiting"
    else:
        state = "running" if silence < NO_BEAT_S else "silent"
    progress = {key: status.get(key) for key in ("step", "gaussians", "seconds_left", "stage", "device")}
    worker = {key: attempt.lease.get(key) for key in ("host", "worker")}
    return {"state": state, "silent": round(max(0.0, silence)), **progress, **worker, **failure}


def format_store_status(status: dict[str, Any]) -> str:
    """Format the result of `store_status` as text, one line per cell."""
    counts_text = ", ".join(f"{count} {state}" for state, count in sorted(status["counts"].items())) or "no cells"
    lines = [f"{status['store']}: {counts_text}"]
    for cell in status["cells"]:
        name = cell["name"] or f"{cell['pipeline']} seed={cell['seed']}"
        lines.append(f"{cell['key']}  {cell['state']:9}  {name}{_format_detail(cell)}")
    return "\n  ".join(map(one_line, lines))


def _format_detail(cell: dict[str, Any]) -> str:
    if cell["state"] == "published":
        psnr = f", {cell['psnr']:.2f} dB" if cell.get("psnr") is not None else ""
        return psnr + (f", {cell['seconds']:.0f} s" if cell["seconds"] is not None else "")
    step = f", step {cell['step']}/{cell['steps']}" if cell.get("step") is not None else ""
    suffix = f": {cell['message']}" if cell.get("message") else ""
    if cell["state"] == "silent":
        advice = "; run the sweep again to continue it" if cell["silent"] > STALE_AFTER_S else ""
        suffix = f", no heartbeat for {cell['silent']} s on {cell.get('host')}{advice}"
    return step + suffix

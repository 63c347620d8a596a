"""Report the state of a folder that contains a run, a sweep store, or a scene in blocks, and verify its files."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from clsplat.core.errors import DataError, one_line, shell_quote
from clsplat.core.files import END_STATES
from clsplat.core.reading import read_json
from clsplat.runs import verify
from clsplat.runs.state import RunState
from clsplat.runs.status import run_status
from clsplat.sweeps.status import is_store, store_status

RECORD, COARSE, MERGED, MANIFEST = "blocks.json", "coarse", "merged", "partition.json"


def block_name(number: int) -> str:
    """Return the name of a block's folder and of its initial model."""
    return f"block_{number:02d}"


def is_in_blocks(folder: Path) -> bool:
    """Return whether a folder contains a scene trained in blocks."""
    return (folder / RECORD).is_file()


def read_status(folder: Path) -> dict[str, Any]:
    """Return the status of a folder that contains a scene in blocks, a sweep store, or a run.  Raises DataError."""
    if is_in_blocks(folder):
        return blocks_status(folder)
    return store_status(folder) if is_store(folder) else run_status(RunState.read(folder))


def check(target: str) -> dict[str, Any]:
    """Call `verify_blocks` for a scene in blocks, and `clsplat.runs.verify.check` otherwise."""
    return verify_blocks(Path(target)) if is_in_blocks(Path(target)) else verify.check(target)


def blocks_status(out: Path) -> dict[str, Any]:
    """Return the `state` of a scene in blocks, and `parts`: the name and status of each run.

    The state is "done" when the merged model is finished, and "running", "failed", or "unfinished" before that.
    Raises DataError if the record is damaged.
    """
    parts = [{"name": name, **_status(out / name)} for name in _run_names(out)]
    states = [part["state"] for part in parts]
    is_running = any(state not in (*END_STATES, "killed", "waiting", "unknown") for state in states)
    state = (
        "done"
        if states[-1] == "done"
        else "running"
        if is_running
        else "failed"
        if "failed" in states
        else "unfinished"
    )
    return {"in_blocks": str(out), "state": state, "parts": parts}


def verify_blocks(out: Path) -> dict[str, Any]:
    """Verify all runs of a scene in blocks and the files that they share.

    Returns a dictionary with the keys of `clsplat.runs.verify.verify`, and `remedy`.
    """
    state = blocks_status(out)["state"]
    objects = list(_check_files(out, state == "done"))
    return {
        "run": str(out),
        "state": state,
        "whole": all(entry["whole"] for entry in objects),
        "objects": objects,
        "remedy": f"run the same `clsplat blocks … --out {shell_quote(out)}` again to restore missing files",
    }


def _run_names(out: Path) -> list[str]:
    """Return the names of the run folders, in the order of training."""
    record = read_json(out / RECORD)
    if not (isinstance(record, dict) and type(record.get("blocks")) is int):
        raise DataError(f"{out / RECORD}: the number of blocks is missing; restore the file, or remove {out}")
    return [*([COARSE] if COARSE in record else []), *map(block_name, range(record["blocks"])), MERGED]


def _status(folder: Path) -> dict[str, Any]:
    try:
        return run_status(state) if (state := RunState.read(folder)).phase else {"state": "waiting"}
    except DataError as error:
        return {"state": "unknown", "message": one_line(error)}


def _check_files(out: Path, is_done: bool) -> Iterator[dict[str, Any]]:
    """Yield the result of verifying each file.  If the scene is done, all files must exist."""

    def describe_manifest(path: Path) -> str:
        data = read_json(path)
        if not (isinstance(data, dict) and isinstance(data.get("blocks"), list)):
            raise DataError("has no list of blocks")
        return f"of {len(data['blocks'])} blocks"

    parts = _run_names(out)
    readers: dict[str, Callable[[Path], str]] = {MANIFEST: describe_manifest}
    readers |= {f"{name}.ply": partial(verify.check_output, None) for name in parts if name != COARSE}
    for name, read in readers.items():
        if is_done or (out / name).exists():
            yield verify.check_file(out, name, read)
    for part in parts:
        if (state := RunState.read(out / part)).phase:
            yield from ({**entry, "file": f"{part}/{entry['file']}"} for entry in verify.verify(state)["objects"])
        elif is_done:
            yield {"file": part, "whole": False, "detail": "is missing"}

"""What a folder holds, of a run, a store of cells or a scene in blocks: its state, and whether its files are whole."""

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
    """Return the name of the folder of a block, and of its first Gaussians."""
    return f"block_{number:02d}"


def is_in_blocks(folder: Path) -> bool:
    """Whether a folder holds a scene in blocks."""
    return (folder / RECORD).is_file()


def status_of(folder: Path) -> dict[str, Any]:
    """Return the state of what a folder holds: a scene in blocks, a store of cells, or a run.  Raises DataError."""
    if is_in_blocks(folder):
        return blocks_status(folder)
    return store_status(folder) if is_store(folder) else run_status(RunState.read(folder))


def check(pipeline: str) -> dict[str, Any]:
    """Check a scene in blocks as `verify_blocks`, and all else as `clsplat.runs.verify`."""
    return verify_blocks(Path(pipeline)) if is_in_blocks(Path(pipeline)) else verify.check(pipeline)


def blocks_status(out: Path) -> dict[str, Any]:
    """Return the `state` of a scene in blocks, and `parts`: what `run_status` returns, and the name, of each run.

    The state is that of the merged model; before it is done running, failed, or unfinished.
    Raises DataError where the record is damaged.
    """
    parts = [{"name": name, **_status(out / name)} for name in _parts(out)]
    states = [part["state"] for part in parts]
    going = any(state not in (*END_STATES, "killed", "waiting", "unknown") for state in states)
    state = "done" if states[-1] == "done" else "running" if going else "failed" if "failed" in states else "unfinished"
    return {"in_blocks": str(out), "state": state, "parts": parts}


def verify_blocks(out: Path) -> dict[str, Any]:
    """Return what `verify` returns, of all runs of a scene in blocks and of the files beside them, with a `remedy`."""
    state = blocks_status(out)["state"]
    objects = list(_objects(out, state == "done"))
    return {
        "run": str(out),
        "state": state,
        "whole": all(one["whole"] for one in objects),
        "objects": objects,
        "remedy": f"run its `clsplat blocks … --out {shell_quote(out)}` again, which makes again what is lost",
    }


def _parts(out: Path) -> list[str]:
    """The folders of its runs, in the order in which they are trained."""
    record = read_json(out / RECORD)
    if not (isinstance(record, dict) and type(record.get("blocks")) is int):
        raise DataError(f"{out / RECORD}: expected the number of blocks; remove {out}, or put that file back")
    return [*([COARSE] if COARSE in record else []), *map(block_name, range(record["blocks"])), MERGED]


def _status(folder: Path) -> dict[str, Any]:
    try:
        return run_status(state) if (state := RunState.read(folder)).phase else {"state": "waiting"}
    except DataError as error:
        return {"state": "unknown", "message": one_line(error)}


def _objects(out: Path, done: bool) -> Iterator[dict[str, Any]]:
    """What is found of each file; those that a scene that is done has must be there."""

    def manifest(path: Path) -> str:
        found = read_json(path)
        if not (isinstance(found, dict) and isinstance(found.get("blocks"), list)):
            raise DataError("expected the blocks, and what they hold")
        return f"of {len(found['blocks'])} blocks"

    parts = _parts(out)
    looks: dict[str, Callable[[Path], str]] = {MANIFEST: manifest}
    looks |= {f"{name}.ply": partial(verify.output, None) for name in parts if name != COARSE}
    for name, look in looks.items():
        if done or (out / name).exists():
            yield verify.check_file(out, name, look)
    for part in parts:
        if (state := RunState.read(out / part)).phase:
            yield from ({**one, "file": f"{part}/{one['file']}"} for one in verify.verify(state)["objects"])
        elif done:
            yield {"file": part, "whole": False, "detail": "is missing"}

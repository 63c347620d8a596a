"""What `clsplat check RUN` says of a run folder."""

from pathlib import Path
from typing import Any

from clsplat.names import CHECKPOINTS, PIPELINE
from clsplat.runs.found import has_state
from clsplat.runs.verify import NO_SUMS


def verdict(found: dict[str, Any]) -> str:
    """Return a sentence about what `verify` found."""
    damaged = [one["file"] for one in found["objects"] if not one["whole"]]
    if not damaged:
        return f"{found['run']}: {found['state']}; all {len(found['objects'])} files are whole"
    if all(one["whole"] or one["detail"] == NO_SUMS for one in found["objects"]):
        return f"{found['run']}: {found['state']}; {damaged[0]} {NO_SUMS}"
    names = ", ".join(damaged[:3]) + (", …" if len(damaged) > 3 else "")
    return (
        f"{found['run']}: {found['state']}; {len(damaged)} of {len(found['objects'])} files are damaged or missing: "
        f"{names}; copy them again, or {_remedy(found, damaged[0])}"
    )


def _remedy(found: dict[str, Any], file: str) -> str:
    """How the run of a damaged file is mended by running it again."""
    out = Path(found["run"])
    cell = next((one for one in (out / file).parents if one != out and out in one.parents and has_state(one)), out)
    prefix = "" if cell == out else f"{cell.relative_to(out).as_posix()}/"
    whole = {one["file"].removeprefix(prefix): one["whole"] for one in found["objects"]}
    checkpoints = [good for name, good in whole.items() if name.startswith(f"{CHECKPOINTS}/step_")]
    if not whole.get(PIPELINE):
        start = "--restart" if checkpoints and not any(checkpoints) else "--resume"
        return f"give its `clsplat run … --out {cell}` again, with {start}"
    if checkpoints and not any(checkpoints):
        return f"begin again: `clsplat run {cell / PIPELINE} --out {cell} --restart`"
    return f"`clsplat resume {cell}` makes them again"


def lines(found: dict[str, Any]) -> str:
    """Return what `verify` found, a line for each file."""
    rows = [
        f"{'whole  ' if one['whole'] else 'DAMAGED'}  {one['file']}{', ' if one['detail'] else ''}{one['detail']}"
        for one in found["objects"]
    ]
    return "\n".join(rows)

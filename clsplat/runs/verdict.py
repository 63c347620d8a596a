"""What `clsplat check RUN` says of a run folder."""

from pathlib import Path
from typing import Any

from clsplat.errors import in_shell
from clsplat.names import PIPELINE
from clsplat.runs.course import beyond_repair
from clsplat.runs.found import has_state, restart
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
        f"{names}; copy them again, or {found.get('remedy') or _remedy(found, damaged[0])}"
    )


def _remedy(found: dict[str, Any], file: str) -> str:
    """How the run of a damaged file is mended by running it again."""
    out = Path(found["run"])
    cell = next((one for one in (out / file).parents if one != out and out in one.parents and has_state(one)), out)
    prefix = "" if cell == out else f"{cell.relative_to(out).as_posix()}/"
    whole = {
        one["file"].removeprefix(prefix): one["whole"] for one in found["objects"] if one["file"].startswith(prefix)
    }
    damaged = [cell / name for name, good in whole.items() if not good]
    left = beyond_repair(cell, damaged)
    if not whole.get(PIPELINE):
        return f"give its `clsplat run … --out {in_shell(cell)}` again, with {'--restart' if left else '--resume'}"
    resume = f"`clsplat resume {in_shell(cell)}` makes them again"
    if not left:
        return resume
    others = "" if len(left) == len(damaged) else f"; {resume} but for {', '.join(map(str, left))}"
    return f"begin again: {restart(cell)}{others}"


def lines(found: dict[str, Any]) -> str:
    """Return what `verify` found, a line for each file."""
    rows = [
        f"{'whole  ' if one['whole'] else 'DAMAGED'}  {one['file']}{', ' if one['detail'] else ''}{one['detail']}"
        for one in found["objects"]
    ]
    return "\n".join(rows)

"""The state of a run, or of a matrix, from the files of its folder alone."""

import logging
import time
from pathlib import Path
from typing import Any

from clsplat.compare.run_folder import read_metrics
from clsplat.errors import DataError, in_shell, one_line
from clsplat.names import END_STATES, METRICS, PIPELINE, SILENT, STATUS
from clsplat.processes import Owner
from clsplat.training import checkpoint
from clsplat.training.found import photographs_text
from clsplat.training.records import Records
from clsplat.training.status import read_status
from clsplat.training.status_schema import status_of

LOG = logging.getLogger("clsplat")


def run_status(out: Path) -> dict[str, Any]:
    """Return what status.json says, the last report and the metrics of a run folder; of a matrix no step.

    state: as there, or killed where its process on this machine has ended; silent: seconds since the heartbeat of a run
    that has not ended, on whatever machine it runs; ahead: seconds by which that is in the future, from a minute on.
    Raises DataError when the folder holds no run, or a damaged status.json or metrics.json.
    """
    status = read_status(out)
    if not status:
        raise DataError(f"{out}: has no readable status.json; expected the folder of a run")
    try:
        known = status_of(status)
    except DataError as error:
        raise DataError(
            f"{out / STATUS}: damaged ({error}); `clsplat check {in_shell(out)}` tells what else is"
        ) from error
    if known is None:
        raise DataError(f"{out / STATUS}: of a newer clsplat; update clsplat to read it")
    status["state"] = state_of(status)
    for own in ("silent", "ahead"):
        status.pop(own, None)
    if status["state"] not in (*END_STATES, "killed"):
        silent = round(time.time() - known.time)
        status["silent"] = max(0, silent)
        if silent <= -SILENT:
            status["ahead"] = -silent
    metrics = None
    if (out / METRICS).exists():
        metrics = read_metrics(out / METRICS).model_dump(exclude_unset=True)
    return {"run": str(out), **status, "last": _last(out), "metrics": metrics}


def _last(out: Path) -> dict[str, Any] | None:
    """The last report; None where there is none, or the records are damaged, which a warning says."""
    try:
        lines = Records(out).read("train")
    except DataError as error:
        LOG.warning("%s", error)
        return None
    return lines[-1] if lines else None


def state_of(status: dict[str, Any]) -> str:
    """Return the state that status.json tells, `killed` where its process has ended without a word."""
    owner = Owner.named_by(status) if status.get("state") not in END_STATES else None
    return "killed" if owner and owner.has_ended else str(status.get("state", "unknown"))


def status_text(status: dict[str, Any]) -> str:
    """Return what run_status found as lines of text."""
    lines = [f"{status['run']}: {status['state']}{_progress(status)}"]
    if status.get("silent", 0) >= SILENT:
        lines.append(f"no sign of life for {status['silent']} s{_place(status)}")
    if status.get("ahead"):
        lines.append(f"its clock is ahead by {status['ahead']} s{_place(status)}: its silence cannot be told")
    if status.get("message"):
        lines.append(status["message"])
    if status["state"] in ("killed", "failed", "interrupted") and (advice := _advice(status)):
        lines.append(advice)
    if status["last"] and status["metrics"] is None:
        lines.append("last report: " + _figures(status["last"], ("step", "loss", "psnr", "gaussians")))
    if placed := photographs_text((status["metrics"] or {}).get("preparation", {})):
        lines.append(placed)
    for split in ("test", "validation", "train"):
        for downscale, figures in ((status["metrics"] or {}).get(split) or {}).items():
            lines.append(f"{split} 1/{downscale}: {_figures(figures, ('psnr', 'ssim', 'lpips', 'views'))}")
    return "\n  ".join(map(one_line, lines))


def _advice(status: dict[str, Any]) -> str:
    """How to go on with a run that has ended before its end."""
    out, message = Path(status["run"]), str(status.get("message"))
    resume = f"clsplat resume {in_shell(out)}"
    if not (out / PIPELINE).is_file() or resume in message or "--restart" in message:
        return ""
    if "cells" in status or checkpoint.saved(out):
        return f"`{resume}` goes on with it"
    if status.get("checkpoint"):  # without which it does not go on
        again = f"`clsplat run {in_shell(out / PIPELINE)} --out {in_shell(out)} --restart`"
        return f"its checkpoints are gone; {again} begins it again"
    return f"no checkpoint was saved; `{resume}` begins it again"


def _progress(status: dict[str, Any]) -> str:
    """Where the run is, and how far its stage."""
    if "cells" in status:
        failed = status["failed"] if isinstance(status.get("failed"), dict) else {}
        return f", {status.get('done')} of {status['cells']} cells, {len(failed)} of them failed"
    last = status["last"] or {}
    step = max((s for s in (status.get("step"), last.get("step")) if isinstance(s, int)), default=None)
    steps = f" of {status['steps']}" if "steps" in status else ""
    amount, count = status.get("progress"), ""
    if isinstance(amount, dict) and amount.get("unit") != "steps":
        count = f", {amount.get('done')} of {amount.get('total')} {amount.get('unit')}"
    left = status.get("seconds_left")
    if status["state"] in END_STATES:
        return f" at step {step}{steps if status['state'] != 'done' else ''}"
    stage = f", {status['stage']}{count}" if status.get("stage") else ""
    time_left = f", {left:.0f} s left" if isinstance(left, int | float) else ""
    return f" at step {step}{steps}{stage}{time_left}"


def _figures(values: dict[str, Any], names: tuple[str, ...]) -> str:
    shown = {name: values[name] for name in names if isinstance(values.get(name), int | float)}
    return ", ".join(
        f"{name} {value:.5g}" if isinstance(value, float) else f"{name} {value}" for name, value in shown.items()
    )


def _place(status: dict[str, Any]) -> str:
    owner = Owner.named_by(status)
    elsewhere = owner is not None and not owner.is_here
    return f"; it runs on {status.get('host')}" if elsewhere else f"; process {status.get('process')}"

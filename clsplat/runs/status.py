"""The state of a run, or of a matrix, from the files of its folder alone."""

import os
from pathlib import Path
from typing import Any

from clsplat.compare.run_folder import read_metrics
from clsplat.errors import DataError
from clsplat.runs.runner import read_status
from clsplat.training.records import Records

END_STATES = ("done", "failed", "interrupted")


def run_status(out: Path) -> dict[str, Any]:
    """Return state, step and metrics of a run folder; of a matrix `cells`, `done` and `failed` instead of the step.

    state: starting, running, done, failed, interrupted, or killed where its process on this machine has ended.
    Raises DataError when the folder holds no run, or a damaged file.
    """
    status = read_status(out)
    if not isinstance(status.get("state"), str):
        raise DataError(f"{out}: has no readable status.json; expected the folder of a run")
    if status["state"] not in END_STATES and not _alive(status.get("process")):
        status["state"] = "killed"
    metrics = None
    if (out / "metrics.json").exists():
        metrics = read_metrics(out / "metrics.json").model_dump(exclude_unset=True)
    lines = Records(out).read("train")
    return {"run": str(out), **status, "last": lines[-1] if lines else None, "metrics": metrics}


def status_text(status: dict[str, Any]) -> str:
    """Return what run_status found as lines of text."""
    lines = [f"{status['run']}: {status['state']}{_progress(status)}"]
    if status.get("message"):
        lines.append(f"  {status['message']}")
    goes_on = "resume" not in str(status.get("message"))
    if (
        goes_on
        and status["state"] in ("killed", "failed", "interrupted")
        and (Path(status["run"]) / "pipeline.yaml").is_file()
    ):
        lines.append(f"  `clsplat resume {status['run']}` goes on with it")
    if status["last"] and status["metrics"] is None:
        lines.append("  last report: " + _figures(status["last"], ("step", "loss", "psnr", "gaussians")))
    for split in ("test", "train"):
        for downscale, figures in ((status["metrics"] or {}).get(split) or {}).items():
            lines.append(f"  {split} 1/{downscale}: {_figures(figures, ('psnr', 'ssim', 'lpips', 'views'))}")
    return "\n".join(lines)


def _progress(status: dict[str, Any]) -> str:
    if "cells" in status:
        failed = status["failed"] if isinstance(status.get("failed"), dict) else {}
        return f", {status.get('done')} of {status['cells']} cells, {len(failed)} of them failed"
    steps = f" of {status['steps']}" if "steps" in status else ""
    return f" at step {status.get('step')}{steps}"


def _figures(values: dict[str, Any], names: tuple[str, ...]) -> str:
    shown = {name: values[name] for name in names if isinstance(values.get(name), int | float)}
    return ", ".join(
        f"{name} {value:.5g}" if isinstance(value, float) else f"{name} {value}" for name, value in shown.items()
    )


def _alive(process: Any) -> bool:
    """Whether a process runs on this machine; True when that is not known."""
    if not isinstance(process, int) or process <= 0:
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True

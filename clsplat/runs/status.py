"""Report the state of a run or a matrix from the files of its folder."""

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from clsplat.core.errors import DataError, one_line, shell_quote, size_text
from clsplat.core.files import END_STATES, HEARTBEAT_TIMEOUT, METRICS, PIPELINE, STATUS
from clsplat.core.machine import Owner
from clsplat.core.reading import read_json
from clsplat.core.settings import variants
from clsplat.prepare.gather import summarize_placement
from clsplat.runs.results import read_metrics
from clsplat.runs.state import RunState
from clsplat.training.modules.base import TrainingModule
from clsplat.training.records import Records
from clsplat.training.status import parse_status

LOG = logging.getLogger("clsplat")


def run_status(state: RunState) -> dict[str, Any]:
    """Return the content of status.json, the last report, and the metrics of a run or a matrix.

    Changed and additional keys:
    state: as in the file, or "killed" if the process ran on this machine and no longer exists
    silent: seconds since the last heartbeat of a run that has not ended
    ahead: seconds by which that heartbeat is in the future, if at least a minute
    advice: how to continue a run that stopped early, or ""
    Raises DataError if the folder has no run, or if status.json or metrics.json is damaged.
    """
    out = state.out
    if not (status := dict(state.status)):
        raise DataError(f"{out}: has no readable status.json; expected a run folder")
    try:
        parsed_status = parse_status(status)
    except DataError as error:
        raise DataError(
            f"{out / STATUS}: damaged ({error}); `clsplat check {shell_quote(out)}` checks the other files"
        ) from error
    if parsed_status is None:
        raise DataError(f"{out / STATUS}: was written by a newer version; update clsplat to read it")
    status["state"] = state.state_name
    for key in ("silent", "ahead"):
        status.pop(key, None)
    if status["state"] not in (*END_STATES, "killed"):
        silent_seconds = round(time.time() - parsed_status.time)
        status["silent"] = max(0, silent_seconds)
        if silent_seconds <= -HEARTBEAT_TIMEOUT:
            status["ahead"] = -silent_seconds
    metrics = None
    if METRICS in state.names:
        metrics = read_metrics(out / METRICS).model_dump(exclude_unset=True)
    has_stopped = status["state"] in ("killed", "failed", "interrupted")
    advice = _advice(state) if has_stopped else ""
    return {"run": str(out), **status, "last": _last_report(out), "metrics": metrics, "advice": advice}


def _last_report(out: Path) -> dict[str, Any] | None:
    """Return the last report of the training; None if there is none.  If the records are damaged, log a warning."""
    try:
        lines = Records(out).read("train")
    except DataError as error:
        LOG.warning("%s", error)
        return None
    return lines[-1] if lines else None


def format_status(status: dict[str, Any]) -> str:
    """Format the result of `run_status` as text."""
    lines = [f"{status['run']}: {status['state']}{_format_progress(status)}"]
    if status.get("silent", 0) >= HEARTBEAT_TIMEOUT:
        lines.append(f"no heartbeat for {status['silent']} s{_describe_process(status)}")
    if status.get("ahead"):
        lines.append(
            f"its machine's clock is {status['ahead']} s ahead{_describe_process(status)}; the run may have ended"
        )
    if status.get("message"):
        lines.append(status["message"])
    if status["advice"]:
        lines.append(status["advice"])
    if status["last"] and status["metrics"] is None:
        lines.append("last report: " + _format_numbers(status["last"], ("step", "loss", "psnr", "gaussians")))
    if placement := summarize_placement((status["metrics"] or {}).get("preparation", {})):
        lines.append(placement)
    for split in ("test", "validation", "train"):
        for downscale, averages in ((status["metrics"] or {}).get(split) or {}).items():
            lines.append(f"{split} 1/{downscale}: {_format_numbers(averages, ('psnr', 'ssim', 'lpips', 'views'))}")
    return "\n  ".join(map(one_line, lines))


def _advice(state: RunState) -> str:
    """Return how to continue a run that stopped before its end, or "" if the message of the run contains it."""
    out, status = state.out, state.status
    message, resume_command = str(status.get("message")), f"clsplat resume {shell_quote(out)}"
    if PIPELINE not in state.names or resume_command in message or "--restart" in message:
        return ""
    if "cells" in status or state.checkpoints:
        return f"`{resume_command}` continues it"
    if status.get("checkpoint"):  # the run cannot continue without a checkpoint
        restart_command = f"`clsplat run {shell_quote(out / PIPELINE)} --out {shell_quote(out)} --restart`"
        return f"its checkpoints are missing; {restart_command} starts it over"
    return f"no checkpoint was saved; `{resume_command}` starts it over"


def _format_progress(status: dict[str, Any]) -> str:
    """Format the progress of the run and of its current stage."""
    if "cells" in status:
        failed = status["failed"] if isinstance(status.get("failed"), dict) else {}
        return f", {status.get('done')} of {status['cells']} cells, {len(failed)} of them failed"
    last_report = status["last"] or {}
    step = max((s for s in (status.get("step"), last_report.get("step")) if isinstance(s, int)), default=None)
    steps = f" of {status['steps']}" if "steps" in status else ""
    progress, count_text = status.get("progress"), ""
    if isinstance(progress, dict) and progress.get("unit") != "steps":
        count_text = f", {progress.get('done')} of {progress.get('total')} {progress.get('unit')}"
    seconds_left = status.get("seconds_left")
    if status["state"] in END_STATES:
        return f" at step {step}{steps if status['state'] != 'done' else ''}"
    stage = f", {status['stage']}{count_text}" if status.get("stage") else ""
    time_left = f", {seconds_left:.0f} s left" if isinstance(seconds_left, int | float) else ""
    return f" at step {step}{steps}{stage}{time_left}"


def _format_numbers(record: dict[str, Any], names: tuple[str, ...]) -> str:
    """Format the numeric values of a record under the given names, such as "step 100, loss 0.1"."""
    values = {name: record[name] for name in names if isinstance(record.get(name), int | float)}
    return ", ".join(
        f"{name} {value:.5g}" if isinstance(value, float) else f"{name} {value}" for name, value in values.items()
    )


def _describe_process(status: dict[str, Any]) -> str:
    """Return the host on which a run is executed, or its process ID if it is on this machine."""
    owner = Owner.from_record(status)
    is_remote = owner is not None and not owner.is_local
    return f"; it runs on {status.get('host')}" if is_remote else f"; process {status.get('process')}"


# The summary of a finished run: quality, files, photos, time, and the next command.

TITLES = {"export": "model", "export_field": "field", "render": "renders", "optimize": "previews"}  # of output files
MIN_SECONDS = 0.5  # shorter stages are omitted


def summarize_run(folder: Path) -> list[str]:
    """Return the lines of the summary; empty for an unfinished run or a matrix.  Raises DataError for damaged files."""
    if not (folder / METRICS).exists():
        return []
    metrics = read_json(folder / METRICS)
    try:
        return list(_summary_lines(folder, metrics))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{folder / METRICS}: the file is damaged; run the pipeline again with --restart") from error


def _summary_lines(folder: Path, metrics: dict[str, Any]) -> Iterator[str]:
    test = next(iter(metrics["test"].values()), None)
    quality = f"test PSNR {test['psnr']:.2f} dB, SSIM {test['ssim']:.4f}; " if test else ""
    size = size_text(metrics["gaussians"], metrics.get("parameters"), metrics.get("sky_gaussians", 0))
    yield f"{quality}{size}; {metrics['train_seconds']:.0f} s of training"
    placement = summarize_placement(metrics.get("preparation", {}))
    if best := metrics.get("kept"):
        model = "best     model of step {:,}" if not best["refit"] else "refit    {:,} steps on all photos"
        yield f"  {model.format(best['step'])}, chosen by a validation PSNR of {best['validation']:.2f} dB"
    yield f"  scene    {metrics['scene']}" + (f"; {placement}" if placement else "")
    files = {stage: folder / name for stage, name in metrics["files"].items()}
    titles = {file: title for module in variants(TrainingModule).values() for file, title in module.side_files.items()}
    paths_by_title = {
        titles.get(path.name) or TITLES.get(stage, stage): path for stage, path in files.items() if path.exists()
    }
    for title, path in paths_by_title.items():
        yield f"  {title:<{max(8, *map(len, paths_by_title))}} {path}"
    seconds = {name: step.get("seconds", 0) for name, step in metrics.get("preparation", {}).items()}
    if times := [f"{name} {s:.0f} s" for name, s in {**seconds, **metrics["seconds"]}.items() if s >= MIN_SECONDS]:
        yield f"  time     {', '.join(times)}"
    page = next((files[stage] for stage in ("report", "viewer") if stage in files and files[stage].exists()), None)
    if page:
        advice = f"; `clsplat resume {shell_quote(folder)} --steps {2 * metrics['steps']}` trains longer"
        if metrics.get("overfit"):
            advice = "; the model overfits: add photos"
        elif best and (best["refit"] or best["step"] < best["last"]["step"]):  # validation found the best step already
            advice = ""
        yield f"next: open {page} in a browser{advice}"

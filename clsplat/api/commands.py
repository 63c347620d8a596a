"""What the commands do, as functions: paths and plain values in, files and plain values out.

The command line prints what these return.  Errors are those of `clsplat.errors`, with the messages of the commands.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from clsplat import plugins

Text = str | Path


def run(
    pipeline: Text,
    scene: Text | None = None,
    out: Text | None = None,
    *,
    set: Mapping[str, Any] | Sequence[str] = (),
    device: str | None = None,
    resume: bool = False,
) -> Path:
    """Run a pipeline or a matrix, as `clsplat run` does; return the run folder.

    pipeline: a file, or the name of a shipped one; out: default runs/NAME; set: values by place, or 'place=value'.
    """
    from clsplat.experiment import Job

    plugins.load_installed()
    job = Job.open(str(pipeline), _path(scene), _path(out), overrides(set), resume)
    job.run(device, resume)
    return job.out


def resume(folder: Text, *, set: Mapping[str, Any] | Sequence[str] = (), device: str | None = None) -> Path:
    """Go on with a run from its newest checkpoint, as `clsplat resume` does; return the run folder."""
    from clsplat.experiment import Job

    plugins.load_installed()
    job = Job.resume(Path(folder), overrides(set))
    job.run(device, resume=True)
    return job.out


def check(pipeline: Text) -> dict[str, Any]:
    """Validate a pipeline: its path, its name, its stages or cells.  Raises ConfigError."""
    from clsplat import experiment

    plugins.load_installed()
    return experiment.check(str(pipeline))


def pipelines(name: str | None = None) -> Any:
    """List the shipped pipelines, or describe one with its keys."""
    from clsplat import recipes

    return recipes.manual(name) if name else recipes.summaries()


def devices() -> list[dict[str, Any]]:
    """List OpenCL devices, their limits, and under `fault` what keeps one from working."""
    from dataclasses import asdict

    from clsplat.opencl.discovery import list_devices

    return [{**asdict(info), "fault": info.fault()} for info in list_devices()]


def render_views(
    model: Text,
    scene: Text | None = None,
    out: Text = "renders",
    *,
    split: Literal["test", "train", "all"] = "test",
    downscale: float | None = None,
    kind: Literal["png", "npy"] = "png",
    device: str | None = None,
) -> int:
    """Render a model file or run folder at the views of a scene into files; return their number."""
    from clsplat import model_file

    plugins.load_installed()
    return model_file.render(
        Path(model), _path(scene), Path(out), split=split, downscale=downscale, kind=kind, device=device
    )


def evaluate(
    model: Text,
    scene: Text | None = None,
    *,
    downscales: Sequence[float] | None = None,
    metrics: Sequence[str] = ("psnr", "ssim"),
    lpips: Text | None = None,
    lpips_input: Literal["-1..1", "0..1"] = "-1..1",
    device: str | None = None,
) -> dict[str, Any]:
    """Measure a model file or run folder on a scene's views; return what metrics.json holds."""
    from clsplat import model_file

    plugins.load_installed()
    return model_file.evaluate(
        Path(model),
        _path(scene),
        downscales=downscales,
        metrics=metrics,
        lpips=_path(lpips),
        lpips_input=lpips_input,
        device=device,
    )


def compare_runs(runs: Sequence[Text], out: Text = "compare.html") -> int:
    """Write the page that shows runs side by side; return the number of runs on it."""
    from clsplat.compare.page import write_comparison

    return write_comparison([Path(folder) for folder in runs], Path(out))


def inspect_scene(scene: Text) -> Any:
    """Look at a dataset: `trainable`, `verdict`, `findings`, `data()`."""
    from clsplat.inspect.inspection import Inspection

    plugins.load_installed()
    return Inspection.of(Path(scene))


def load_plugin(file: Text) -> None:
    """Import a plug-in, as `--plugin` does.  Raises ConfigError, with file and line, when that fails."""
    plugins.load_file(Path(file))


def overrides(values: Mapping[str, Any] | Sequence[str]) -> list[str]:
    """Return settings as `--set` takes them."""
    if isinstance(values, Mapping):
        return [f"{place}={json.dumps(value)}" for place, value in values.items()]
    return list(values)


def _path(value: Text | None) -> Path | None:
    return None if value is None else Path(value)

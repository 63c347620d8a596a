"""The run as one page that opens offline: pictures, cameras, figures, curves, times on the device, settings."""

import logging
import os
from pathlib import Path
from typing import Annotated, ClassVar, Literal
from urllib.parse import quote

from clsplat.errors import amount
from clsplat.files import write_text
from clsplat.names import PIPELINE
from clsplat.pages.page import duration, render, require_end
from clsplat.reading import read_text
from clsplat.report.advice import advice
from clsplat.report.cameras import cameras
from clsplat.report.charts import gaussians_charts, training_charts
from clsplat.report.parting import parting
from clsplat.report.times import times
from clsplat.report.views import views
from clsplat.scene.scene import SPLITS
from clsplat.stages.base import Stage, path_in_run
from clsplat.training.found import photographs_text, size_text
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
MORE = {  # metrics/colours.py, metrics/stillness.py, metrics/held_out.py: name and unit
    "psnr_colour": ("PSNR in the photographs' colours", "dB"),
    "psnr_affine": ("PSNR with colours fitted", "dB"),
    "psnr_held_out_moments": ("PSNR at held-out moments", "dB"),
    "psnr_other_moments": ("PSNR at other moments", "dB"),
    "psnr_static": ("PSNR of static pixels", "dB"),
    "flicker": ("flicker of static pixels", "levels"),
    "flicker_photographs": ("flicker of the photographs there", "levels"),
}


class Report(Stage):
    """Write report.html."""

    stage: Literal["report"] = "report"
    needs: ClassVar[frozenset[str]] = frozenset({"painter", "metrics"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"file"})

    file: Annotated[str, path_in_run(".html")] = "report.html"
    """Path inside the run folder."""

    def run(self, run: Run) -> None:
        advised = advice(run)
        page = render(
            "report.html.j2",
            title=run.scene_name,
            subtitle=f"{run.name} · {run.device.text}",
            main=_main(run),
            parting=parting(run),
            advice=advised,
            photographs=photographs_text(run.found) or f"{amount(len(run.original.views), 'photograph')}",
            viewers=_addresses(run, "viewer", run.out / self.file),
            models=_addresses(run, "export", run.out / self.file),
            views=views(run),
            cameras=cameras(run),
            figures=_figures(run),
            training=training_charts(run),
            gaussians=gaussians_charts(run),
            times=times(run),
            settings=_settings(run),
        )
        write_text(run.out / self.file, page)
        LOG.info("report written to %s", run.out / self.file)
        for text in advised:
            LOG.info("advice: %s", text)

    def verify(self, run: Run) -> None:
        require_end(run.out / self.file)


def _addresses(run: Run, stage: str, page: Path) -> dict[str, str]:
    """The files that stages of this name write, by their paths in the run, with their addresses beside the page."""
    files = [Path(one[stage]["file"]) for one in run.pipeline["stages"] if stage in one]
    return {file.as_posix(): quote(Path(os.path.relpath(run.out / file, page.parent)).as_posix()) for file in files}


def _main(run: Run) -> str:
    """The figures that are looked for first."""
    test = run.metrics.get("test", {}).get(f"{run.downscale:g}")
    quality = [f"test PSNR {test['psnr']:.2f} dB, SSIM {test['ssim']:.4f}"] if test else []
    quality += [f"the model of step {run.model_step:,}"] if run.model_step != run.step else []
    others = _size(run), f"trained for {duration(run.train_seconds)}"
    return " · ".join([*quality, *others])


def _size(run: Run) -> str:
    return size_text(run.gaussians, run.learned_field.parameters if run.learned_field else None)


def _figures(run: Run) -> dict[str, str]:
    values = {}
    for split, by_downscale in sorted(run.metrics.items(), key=lambda item: SPLITS.index(item[0])):
        for downscale, averages in by_downscale.items():
            suffix = "" if downscale == f"{run.downscale:g}" else f" at 1/{downscale}"
            values[f"{split} PSNR{suffix} ({amount(averages['views'], 'view')})"] = f"{averages['psnr']:.2f} dB"
            for key, (name, unit) in MORE.items():
                if averages.get(key) is not None:
                    some = f" ({amount(averages[f'{key}_views'], 'view')})" if f"{key}_views" in averages else ""
                    values[f"{split} {name}{suffix}{some}"] = f"{averages[key]:.2f} {unit}"
            values[f"{split} SSIM{suffix}"] = f"{averages['ssim']:.4f}"
    if run.is_refit and run.best:
        found = run.best.found
        values["validation PSNR before the refit"] = f"{found.validation:.2f} dB"
        values["training PSNR before the refit"] = f"{found.train:.2f} dB"
    number, _, what = _size(run).partition(" ")
    values[what] = number
    values["steps"] = f"{run.step:,}"
    values["training"] = duration(run.train_seconds)
    return values


def _settings(run: Run) -> str:
    path = run.out / PIPELINE
    return read_text(path) if path.exists() else ""

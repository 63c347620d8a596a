"""What a training tells of itself every so many steps."""

from collections.abc import Sequence
from statistics import fmean, median

from clsplat.metrics.distribution import distribution
from clsplat.progress import Progress
from clsplat.training.forecast import Forecast
from clsplat.training.profile import stage_milliseconds
from clsplat.training.run import Run


def report(
    run: Run, forecast: Forecast, values: tuple[float, float], seconds: Sequence[float], distribution_every: int = 1
) -> None:
    """Record a step and show it.

    values: its loss and its PSNR, dB; seconds: of the steps since the last report; distribution_every: steps from one
    record of the Gaussians' sizes and opacities to the next.
    """
    count, (loss, psnr) = run.gaussians, values
    stages, ms = stage_milliseconds(run.device.timings), 1e3 * median(seconds)  # the first step may load much
    cost = {"ms": ms, "cpu_seconds": round(run.cpu_seconds, 3), "stages": stages}
    run.records.add(run.step, "train", loss=loss, psnr=psnr, **({} if count is None else {"gaussians": count}), **cost)
    if count is not None and (run.step % distribution_every == 0 or run.step == forecast.last_step):
        run.records.add(run.step, "distribution", gaussians=count, **distribution(run.model.gaussians))
    run.records.write()
    forecast.add(run.step, psnr, count or 1, fmean(seconds))
    left, known = forecast.seconds_left, forecast.growth_known
    run.status.note(gaussians=count, seconds_left=round(left, 1))
    run.show(Progress(run.step, forecast.last_step, loss, forecast.psnr, count, ms, left, known))

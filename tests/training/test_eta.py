"""Progress reports: the remaining time and the PSNR."""

import pytest

from clsplat.core.progress import Progress
from clsplat.core.terminal import progress_line
from clsplat.training.records import PSNR_REPORTS, Forecast

LAST, GROWTH_END = 3000, 1600


def count_at(step: int) -> int:
    """Gaussians: growth from step 200 on."""
    return 8000 + 30 * max(0, min(step, GROWTH_END) - 200)


def seconds_at(step: int) -> float:
    """A step has a part of its own and one by Gaussians."""
    return 0.004 + 1e-6 * count_at(step)


def forecast_at(step: int) -> Forecast:
    forecast = Forecast(LAST, GROWTH_END)
    for report in range(100, step + 1, 100):
        seconds = sum(seconds_at(item) for item in range(report - 99, report + 1)) / 100
        forecast.add(report, 20.0, count_at(report), seconds)
    return forecast


@pytest.mark.parametrize(("step", "tolerance"), [(600, 0.25), (1500, 0.1), (2000, 0.01), (3000, 0)])
def test_time_left_includes_future_growth(step, tolerance):
    true = sum(map(seconds_at, range(step + 1, LAST + 1)))
    assert forecast_at(step).seconds_left == pytest.approx(true, rel=tolerance)


def test_time_left_is_a_lower_bound_before_growth():
    early = forecast_at(200)
    assert not early.is_growth_known
    assert early.seconds_left == pytest.approx(seconds_at(100) * (LAST - 200))
    assert forecast_at(400).is_growth_known
    progress = Progress(200, LAST, 0.1, 20.0, 8000, 12.0, early.seconds_left, early.is_growth_known)
    assert progress_line(progress).endswith("at least 0:34 left")


def test_time_left_without_growth_is_proportional():
    forecast = Forecast.from_rules(0, 100, [])
    forecast.add(50, 20.0, 7, 0.5)
    assert forecast.is_growth_known
    assert forecast.seconds_left == 25


def test_growth_ends_with_the_last_edit():
    assert Forecast.from_rules(0, 1000, [lambda step: step % 100 == 0 and step < 700]).growth_end == 600
    assert Forecast.from_rules(0, 1000, [lambda step: step % 100 == 0]).growth_end == 900, (
        "no edit follows the last step"
    )
    assert Forecast.from_rules(950, 1000, [lambda step: step % 100 == 0]).growth_end == 950


def test_psnr_is_the_mean_over_the_last_views():
    forecast = Forecast(LAST, 0)
    for number in range(PSNR_REPORTS + 3):
        forecast.add(number, float(number), 1, 1.0)
    assert forecast.psnr == pytest.approx(3 + (PSNR_REPORTS - 1) / 2)

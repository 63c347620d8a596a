"""Charts of pages: ticks, legends, and curves."""

import re
from types import SimpleNamespace

import pytest

from clsplat.stages.report import training_charts
from clsplat.training.records import PSNR_REPORTS, Forecast, moving_average
from clsplat.viewer.charts import HEIGHT, Line, histogram, line_chart


def rows(chart: str) -> list[str]:
    """The labels of the y axis."""
    return re.findall(r'text-anchor="end">([^<]+)<', chart)


def columns(chart: str) -> list[str]:
    """The labels of the x axis."""
    return re.findall(rf'y="{HEIGHT - 10}" text-anchor="middle">([^<]+)<', chart)


def test_nonfinite_points_are_omitted():
    odd = [(1, float("nan")), (2, float("inf")), (3, 5.0), (4, 6.0)]
    assert rows(line_chart("a", [Line(odd)])) == rows(line_chart("a", [Line(odd[2:])]))
    assert line_chart("a", [Line(odd[:2])], logarithmic=True) == ""


@pytest.mark.parametrize(("counts", "labels"), [
    ((8040, 8041), ["8,040", "8,041"]),
    ((8035, 8042), ["8,036", "8,038", "8,040", "8,042"]),
    ((2, 3), ["2", "3"]),
    ((8000, 8900), ["8k", "8.5k"]),
    ((100_000, 100_800), ["100k", "100.2k", "100.4k", "100.6k", "100.8k"]),
    ((156_855, 157_062), ["156.9k", "157k"]),
])  # fmt: skip
def test_ticks_of_counts_are_integers(counts, labels):
    chart = line_chart("Gaussians", [Line(list(zip((10.0, 20.0), map(float, counts), strict=True)))])
    assert rows(chart) == labels


def test_charts_with_a_single_value_are_omitted():
    assert line_chart("Gaussians", [Line([(10.0, 8.0), (20.0, 8.0)])]) == ""
    assert line_chart("PSNR", [Line([(10.0, 8.0)]), Line([(10.0, 9.0)])]) == ""
    assert histogram("points", [7.0, 7.0]) == ""


def test_only_ticks_of_steps_are_integers():
    chart = line_chart("PSNR, dB", [Line([(1.0, 20.5), (3.0, 21.25)])])
    assert columns(chart) == ["0", "1", "2", "3"]
    assert rows(chart) == ["20.6", "20.8", "21", "21.2"]
    assert rows(histogram("points", [1.0, 5.0])) == ["0", "1"]


def test_lines_of_one_color_have_different_dashes():
    points = [(0.0, 0.0), (1.0, 1.0)]
    chart = line_chart("PSNR", [Line(points, "A one", "#123456"), Line(points, "A two", "#123456", dash=1)])
    assert re.findall(r">([^<]+)</tspan>", chart) == ["A one", "A two (dashed)"]
    assert chart.count("stroke-dasharray") == 1


def test_report_and_terminal_show_the_same_psnr():
    """A mean over views; single ones differ by many dB."""
    psnrs = [20.0, 30.0, 22.0, 31.0, 21.0, 29.0, 24.0]
    forecast, seen = Forecast(100, 0), []
    for i, psnr in enumerate(psnrs, 1):
        forecast.add(i, psnr, 10, 0.1)
        seen.append(forecast.psnr)
    assert moving_average(psnrs) == pytest.approx(seen)
    train = [{"step": i, "psnr": psnr, "loss": 0.1, "gaussians": 9, "ms": 1.0} for i, psnr in enumerate(psnrs, 1)]
    records = SimpleNamespace(read=lambda kind, trial=False: [] if trial else train if kind == "train" else [
        {"step": step, "split": "test", "downscale": 1.0, "psnr": psnr} for step, psnr in ((1, 20.0), (7, 31.0))
    ])  # fmt: skip
    chart = str(training_charts(SimpleNamespace(records=records, downscale=1.0))[0])
    assert f">training views, mean of the last {PSNR_REPORTS}</tspan>" in chart
    heights = [float(place.split(",")[1]) for place in re.search(r'points="([^"]+)"', chart).group(1).split()]
    low, high = heights[0], heights[1]
    steps = [(low - height) / (low - high) for height in heights]
    assert steps == pytest.approx([(value - seen[0]) / (seen[1] - seen[0]) for value in seen], abs=0.02)

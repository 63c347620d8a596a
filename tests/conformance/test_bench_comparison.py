"""An earlier measurement beside one of now: what is refused, and what is told of the two."""

import json

import pytest

from clsplat.bench.comparison import beside, read_measurement
from clsplat.errors import ConfigError

PEAKS = {"gflops": 60.0, "gexp": 3.0, "gbytes": 10.0}
TIMES = {"stages": {"sort": 1.0}, "host": 0.5, "step": 2.0, "densify": 9.0}


def measurement(**changes):
    return {"device": "a chip", "pipeline": "splat", "peaks": PEAKS, "scenes": {"A": TIMES}, **changes}


def test_measurement_is_read_without_its_own_baseline(tmp_path):
    (tmp_path / "x.json").write_text(json.dumps(measurement(against=measurement())))
    assert read_measurement(tmp_path / "x.json", "splat") == measurement()


@pytest.mark.parametrize(
    ("data", "place"),
    [
        ([], "the file"),
        ({}, "device"),
        (measurement(peaks={**PEAKS, "gexp": "fast"}), "peaks.gexp"),
        (measurement(scenes={"A": {**TIMES, "stages": 3}}), "scenes.A.stages"),
        (measurement(scenes={"A": {"stages": {}}}), "scenes.A.host"),
    ],
)
def test_what_is_no_measurement_is_refused_with_its_place(data, place, tmp_path):
    (tmp_path / "x.json").write_text(json.dumps(data))
    with pytest.raises(ConfigError, match=rf"x\.json: {place}: .*expected the JSON of an earlier"):
        read_measurement(tmp_path / "x.json", "splat")


def test_the_same_device_as_fast_as_before_needs_no_remark():
    assert beside(measurement(), measurement()) == ["earlier: 60 GFLOP/s, 3.0 Gexp/s, copy 10.0 GB/s"]


def test_another_device_is_named():
    assert "  of another device: 'a chip'" in beside(measurement(device="another"), measurement())


def test_a_machine_that_gives_less_is_told():
    slower = measurement(peaks={**PEAKS, "gflops": 45.0})
    told = "0.75 of its GFLOP/s, 1.00 of its Gexp/s, 1.00 of its GB/s"
    assert told in "".join(beside(slower, measurement()))


def test_a_scene_that_was_not_measured_is_told():
    assert "  has not measured: B; there are A" in beside(measurement(scenes={"A": TIMES, "B": TIMES}), measurement())

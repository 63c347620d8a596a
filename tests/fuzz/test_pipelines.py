"""Damaged pipeline files and values of `--set`."""

from pathlib import Path

import pytest

from clsplat.pipeline.files import shipped_pipelines
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import load_experiment
from clsplat.pipeline.overrides import list_keys
from clsplat.runs.results import read_metrics
from clsplat.training.records import Records
from tests.fuzz.mutation import WORDS, damaged, fuzzed, one_of
from tests.fuzz.outcome import outcome

YAML = [
    "&a ",
    "*a",
    "<<: *a",
    "!!float ",
    "!!set {a}",
    "!!python/object/apply:os.system ",
    "!mine ",
    "? ",
    ": ",
    "- ",
    "|",
]
YAML += ["stages:", "during:", "prepare:", "matrix:", "plugins: {a: b}", "name: x\n", "seed: ", "2024-01-01", "&a [*a]"]
YAML += [
    "- init\n",
    "- optimize: {steps: 3}\n",
    "[[0, 1], [5, 2]]",
    "{points: [[0, 1]], between: steps}",
    "#",
    "'",
    '"',
]
MATRIX = b"name: m\nmatrix:\n  pipelines: [smoke]\n  seeds: [0, 1]\n  set: {optimize.steps: [3, 4], init.count: [5]}\n"
METRICS = b'{"test": {"1": {"psnr": 20.0, "ssim": 0.5, "lpips": null, "views": 2}}, "train": {}, "gaussians": 3, '
METRICS += b'"steps": 4, "train_seconds": 1.5, "seed": 0, "device": "d", "pipeline": "p"}'
LINES = b'{"step": 1, "kind": "train", "loss": 0.5}\n{"step": 2, "kind": "densify", "added": 3}\n'


def test_damaged_pipeline_is_valid_or_refused(folder):
    seeds = [shipped_pipelines()[name].read_bytes() for name in ("smoke", "splat", "photos", "micro_splatting")]
    seeds += [load("smoke").text().encode(), load("mip_splatting").text().encode()]

    @fuzzed(data=damaged(seeds, YAML))
    def reads(data):
        (folder / "x.yaml").write_bytes(data)
        pipeline = outcome(load, str(folder / "x.yaml"))
        if pipeline is not None:
            (folder / "again.yaml").write_text(pipeline.text(), encoding="utf-8")
            assert load(str(folder / "again.yaml")).resolved_settings() == pipeline.resolved_settings()

    reads()


def test_damaged_matrix_is_valid_or_refused(folder):
    @fuzzed(
        data=damaged([MATRIX, MATRIX.replace(b"  pipelines: [smoke]\n", b"") + load("smoke").text().encode()], YAML)
    )
    def reads(data):
        (folder / "m.yaml").write_bytes(data)
        outcome(load_experiment, str(folder / "m.yaml"))

    reads()


def overrides() -> list[bytes]:
    return [key.text.encode() for name in ("smoke", "micro_splatting") for key in list_keys(load(name).settings)]


@pytest.mark.parametrize("name", ["smoke", "micro_splatting"])
def test_damaged_setting_is_valid_or_refused(name):
    first = damaged(overrides(), [*YAML, "stages[0]", ".", "=", "[", "]"])

    @fuzzed(100, data=lambda random: [first(random) for _ in range(random.randint(1, 2))])
    def reads(data):
        pipeline = outcome(load, name, [text.decode("utf-8", "surrogateescape") for text in data])
        if pipeline is not None:
            pipeline.text()

    reads()


def test_any_string_value_is_valid_or_refused():
    places = [key.key_path for key in list_keys(load("splat_7k").settings)]

    @fuzzed(100, place=one_of(places), word=one_of([*WORDS, *YAML]))
    def reads(place, word):
        outcome(load, "splat_7k", [f"{place}={word}"])

    reads()


def test_damaged_metrics_are_read_or_refused(folder: Path):
    @fuzzed(data=damaged([METRICS]))
    def reads(data):
        (folder / "metrics.json").write_bytes(data)
        outcome(read_metrics, folder / "metrics.json")

    reads()


def test_damaged_records_are_read_or_refused(folder: Path):
    """A run that goes on writes those that it keeps again."""
    records = Records(folder)

    @fuzzed(data=damaged([LINES], ["null\n", '{"step": true, "kind": "x"}\n']))
    def reads(data):
        records.path.write_bytes(data)
        records.line_count = 1
        if outcome(records.read) is not None:
            records.start()
            assert len(records.read()) == records.line_count <= 1

    reads()

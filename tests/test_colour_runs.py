"""Whole runs in which photographs have colours of their own."""

import shutil
from pathlib import Path

import pytest

from tests.few_steps import FEW
from tests.test_training import digest, train

pytestmark = pytest.mark.slow
GAIN = (*FEW, "optimize.colours=gain")


@pytest.fixture(scope="module")
def with_gains(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of twelve steps with an exposure of each photograph; nothing is changed in it."""
    out = tmp_path_factory.mktemp("runs") / "gains"
    train(tiny_scene, out, *GAIN)
    return out


def test_a_resumed_run_ends_with_the_bits_of_one_that_was_not(with_gains, tiny_scene, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(with_gains, out)
    (out / "checkpoints" / "step_000012.npz").unlink()
    for name in ("point_cloud.ply", "metrics.json", "checksums.json"):
        (out / name).unlink()
    run = train(tiny_scene, out, *GAIN, resume=True)
    again = train(tiny_scene, tmp_path / "again", *GAIN)
    assert digest(out) == digest(with_gains) == digest(tmp_path / "again")
    assert run.numbers == again.numbers


def test_each_visit_counts_for_its_photograph_and_the_mean_stays(tiny_scene, tmp_path, few_steps):
    run = train(tiny_scene, tmp_path / "run", *GAIN)
    names = [view.name for view in run.scene.split("train")]
    updates = [run.numbers.get(f"colours/{name}/exposure/updates", 0) for name in names]
    assert sum(updates) == 12
    assert len(set(updates)) > 1, "eight photographs, twelve steps"
    for column in ("exposure", "red", "blue"):
        values = [run.numbers[f"colours/{name}/{column}"] for name in names]
        assert sum(values) == pytest.approx(0, abs=1e-12)
        assert max(map(abs, values)) > 1e-3
    assert digest(tmp_path / "run") != digest(few_steps)

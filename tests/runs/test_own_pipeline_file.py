"""A pipeline.yaml that a user wrote is no run folder's: no run takes its place."""

from pathlib import Path
from typing import get_args

import pytest

from clsplat.errors import ConfigError
from clsplat.pipeline.files import shipped
from clsplat.runs.experiment import Job
from clsplat.runs.folders import Start, check_run_folder


@pytest.mark.parametrize("start", get_args(Start))
def test_a_run_does_not_take_the_place_of_a_users_file(tiny_scene: Path, tmp_path: Path, start):
    own = tmp_path / "pipeline.yaml"
    own.write_bytes(shipped()["smoke"].read_bytes())
    for act in (lambda job: job.describe(), lambda job: job.run()):
        with pytest.raises(ConfigError, match=r"pipeline.yaml: is not that of a run.*give another folder"):
            act(Job.open(str(own), tiny_scene, tmp_path, start=start))
    assert own.read_bytes() == shipped()["smoke"].read_bytes()
    assert list(tmp_path.iterdir()) == [own]


@pytest.mark.parametrize("sign", ["status.json", "checkpoints/step_000004.npz", "its first line"])
def test_what_a_run_wrote_is_begun_again(tmp_path: Path, sign):
    (tmp_path / "pipeline.yaml").write_text("# resolved from x.yaml\n" if sign == "its first line" else "name: x\n")
    if sign != "its first line":
        (tmp_path / sign).parent.mkdir(exist_ok=True)
        (tmp_path / sign).write_bytes(b"{}")
    check_run_folder(tmp_path, "restart")

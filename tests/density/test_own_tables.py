"""A custom rule with a table: the table follows the Gaussians and is restored on resume."""

from typing import Literal

import pytest

from clsplat.core.errors import Interrupted
from clsplat.core.progress import Progress
from clsplat.core.settings import rebuild_models
from clsplat.density.edit import Edit, Rule
from clsplat.gaussians.gaussians import Gaussians
from clsplat.pipeline.loading import load
from clsplat.runs import opening, runner
from tests.support.runs import train

pytestmark = pytest.mark.slow

SETTINGS = ("densify.rules=[clone, split, edits_seen]", "densify.start=5", "densify.every=10")


@pytest.fixture
def edits_seen(without_plugins):
    class EditsSeen(Rule):
        """Removes a Gaussian that has seen three edits."""

        type: Literal["edits_seen"] = "edits_seen"

        def mark(self, edit: Edit) -> None:
            gaussians: Gaussians = edit.gaussians
            if "edits_seen" not in gaussians.tables:
                gaussians.add("edits_seen", 1, zero_fresh=True)
            seen = gaussians.get("edits_seen") + 1
            gaussians.set("edits_seen", seen)
            edit.choose(seen[:, 0] >= 3, copies=0, old_rows=0)

    rebuild_models()


@pytest.mark.usefixtures("edits_seen")
def test_table_of_a_rule_returns_on_resume(tiny_scene, tmp_path):
    whole = train(tiny_scene, tmp_path / "whole", *SETTINGS)
    assert sum(record["causes"].get("edits_seen", 0) for record in whole.records.read("densify")) > 0
    checked = load("smoke", [f"scene.path='{tiny_scene}'", *SETTINGS])
    out = tmp_path / "stopped"
    run = opening.open_run(checked, out, None)

    def stop(progress: Progress) -> None:
        run.interrupted = progress.step >= 20

    with pytest.raises(Interrupted):
        runner.execute(checked, run, "new", stop)
    resumed = train(tiny_scene, out, *SETTINGS, resume=True)
    assert resumed.model.gaussians.tables["edits_seen"].zero_fresh
    assert (out / "point_cloud.ply").read_bytes() == (whole.out / "point_cloud.ply").read_bytes()

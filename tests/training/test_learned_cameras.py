"""The recipe that compares learned cameras with those of the dataset."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from clsplat.pipeline.loading import load
from tests.support.commands import clsplat as command
from tests.support.outdoor_scene import Yard

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
RECIPE = ROOT / "examples" / "learned_cameras.yaml"
FEW = "--set", "optimize.steps=8"


def test_original_and_optimized_cameras_are_compared_fairly(rng, tmp_path, monkeypatch):
    """By the commands of the file's header; with names that have blanks, which COLMAP's text cannot hold."""
    monkeypatch.chdir(tmp_path)
    yard = Yard(rng)
    yard.views = [replace(view, name=f"a walk/view {view.name}") for view in yard.views]
    yard.write(Path("my_scene"))
    asked = "--set", "optimize.modules.camera_optimizer={start: 2}", "--set", "scene.holdout=0"
    command("run", "splat_7k", "--scene", "my_scene", *asked, *FEW, "--out", "runs/learned")
    command("data", "cameras", "runs/learned", "learned_scene", "--format", "nerfstudio", "--images", "copy")
    command("run", RECIPE, *FEW)
    tested, bits = [], set()
    for scene in ("my_scene", "learned_scene"):
        out = Path("runs/learned_cameras") / f"splat_7k-{scene}"
        rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
        tested.append({row["view"].removeprefix("images/") for row in rows if row["kind"] == "view"})
        settings = load(str(out / "pipeline.yaml")).settings
        assert not settings.training.modules
        bits.add((out / "point_cloud.ply").read_bytes())
    assert tested[0] == tested[1] == {"a walk/view 0.png", "a walk/view 6.png"}
    assert len(bits) == 2, "of other cameras"
    page = Path("runs/learned_cameras/compare.html").read_text()
    assert all(f"splat_7k-{scene}" in page for scene in ("my_scene", "learned_scene"))


def test_page_has_the_commands_of_the_file():
    commands = re.findall(r"^#   (clsplat .*)$", RECIPE.read_text(), re.M)
    page = (ROOT / "docs" / "difficult_captures.md").read_text()
    assert len(commands) == 3
    assert [line for line in commands if line not in page] == []

"""Kinds of recipes in few steps: the same bits again, after a stop, and with one thread instead of two.

Methods of growth also take the filters and losses of others.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from clsplat.core.errors import ConfigError
from clsplat.gaussians.model import load as load_model
from clsplat.pipeline.loading import load
from clsplat.training import checkpoint, records
from clsplat.training.checkpoint import State
from tests.support.recipes import ONE_THREAD, digest, short, train

pytestmark = pytest.mark.slow

RECIPES = (  # each has a rule, loss, filter or transform that no other one of them has; test_dynamic.py has motion
    "auto_7k", "auto_opti3dgs_7k", "box_7k", "dash_7k", "fast", "fastgs_7k", "gdgs_7k", "improved_gs_7k", "mcmc_7k",
    "micro_splatting_v2_7k", "mini_7k", "mip_splatting_gof_7k", "opti3dgs_7k", "smoke", "speedy_7k", "splat_ewa_7k",
    "steep_7k", "taming_7k",
)  # fmt: skip
LOOKS_AT_VIEWS = {"fastgs_7k", "speedy_7k", "mini_7k", "taming_7k"}
ACTS = {  # what decides in a family of recipes; `clone` in all others
    "auto": "clone split prune_redundant", "fast": "clone prune_useless",
    "fastgs": "split prune_inaccurate", "gdgs": "clone_dense", "improved_gs": "split_long_axis", "mcmc": "relocate",
    "micro_splatting_v2": "split_textured merge_neighbors prune_unimportant",
    "mini": "clone prune_useless", "speedy": "prune_least", "steep": "split_steepest",
}  # fmt: skip
LEARNS = {"auto_opti3dgs_7k"}
ALONE = """
import functools, sys
from pathlib import Path
from clsplat.opencl import device
from tests.support.recipes import STEPS, short, train
device.create_context, device.build = functools.cache(device.create_context), functools.cache(device.build)
for name in sys.argv[3:]:
    train(short(name, Path(sys.argv[1]), saved=STEPS), Path(sys.argv[2]) / name)
"""


def newest(out: Path) -> State:
    return checkpoint.load(checkpoint.list_files(out)[-1])[0]


@pytest.fixture(scope="module")
def with_one_thread(tiny_scene, tmp_path_factory):
    """The runs of a process with one thread; their bits are the same whether or not they save checkpoints."""
    folder = tmp_path_factory.mktemp("alone")
    command = [sys.executable, "-c", ALONE, tiny_scene, folder, *RECIPES]
    environment = {**os.environ, **ONE_THREAD}
    done = subprocess.run(command, cwd=Path(__file__).parents[2], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.parametrize("name", RECIPES)
def test_recipe_has_the_same_bits_after_a_stop_and_on_one_thread(name, tiny_scene, tmp_path, with_one_thread):
    pipeline = short(name, tiny_scene)
    expected = train(pipeline, tmp_path / "run")
    edits = records.Records(tmp_path / "run").read("densify")
    for rule in ACTS.get(name.removesuffix("_7k"), "clone").split() if edits else []:
        assert sum(edit["causes"].get(rule, 0) for edit in edits) > 0, rule
    if name in LOOKS_AT_VIEWS:
        assert any(edit["after"] > edit["before"] for edit in edits)
        removed = sum(number for edit in edits for cause, number in edit["causes"].items() if cause.startswith("prune"))
        assert removed > 0 or "taming" in name, "none is faint, so soon"
    assert digest(with_one_thread / name) == expected
    modules = newest(tmp_path / "run").modules
    assert newest(with_one_thread / name).modules == modules
    assert name not in LEARNS or modules["haar"]["haar/scale"] != 0
    stopped = tmp_path / "stopped"
    shutil.copytree(tmp_path / "run", stopped)
    *_, last = sorted((stopped / "checkpoints").iterdir())
    last.unlink()
    for file in ("point_cloud.ply", "metrics.json", "checksums.json", "status.json"):
        (stopped / file).unlink()
    assert len(list((stopped / "checkpoints").iterdir())) > 0
    assert train(pipeline, stopped, resume=True) == expected
    assert newest(stopped).modules == modules


FAMILIES = ("absgs", "auto_opti3dgs", "dash", "fast", "fastgs", "gdgs", "mcmc", "mini", "speedy", "taming")
EWA = ["model.screen_filter={type: ewa, variance: 0.3}"]
MIP = ["model.screen_filter={type: mip, variance: 0.1}", "model.world_filter={type: smoothing, variance: 0.2}"]
BOX = ["model.screen_filter=box"]
MICRO = [
    "optimize.losses=[{type: l1, weight: 0.4}, {type: l2, weight: 4.0}, {type: dssim, weight: 0.2}, "
    "{type: covariance_trace, weight: 0.01, pixels: 64.0}]"
]


@pytest.mark.parametrize("name", [*FAMILIES, "auto", "steep"])
def test_recipes_accept_filters_and_losses_of_others(name):
    """Each pair is checked as a whole; the pixel's box has no conic, which some rules read."""
    for settings in (EWA, MIP, MICRO):
        load(name, settings)
    if name not in FAMILIES:
        with pytest.raises(ConfigError, match="reads the inverse covariance"):
            load(name, BOX)
    else:
        load(name, BOX)


@pytest.mark.parametrize(
    ("name", "settings", "variance"),
    [("mcmc_7k", EWA, 0.3), ("steep_7k", MIP, 0.1), ("mini_7k", MICRO, 0.3)],
    ids=["mcmc with ewa", "steep with mip", "mini with micro"],
)
def test_three_recipes_train(name, settings, variance, tiny_scene, tmp_path, with_one_thread):
    own = digest(with_one_thread / name)
    assert train(short(name, tiny_scene, *settings), tmp_path / "both") != own
    rendering = load_model(tmp_path / "both").rendering
    assert (rendering.screen_variance, rendering.compensate) == (pytest.approx(variance), float(settings is not MICRO))

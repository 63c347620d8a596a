"""Methods of growth with the filters and losses of others, by a line each."""

import pytest

from clsplat.errors import ConfigError
from clsplat.gaussians.model import load as load_model
from clsplat.pipeline.files import shipped
from clsplat.pipeline.loading import load
from tests.support.recipes import short, train

pytestmark = pytest.mark.slow

FAMILIES = {"absgs", "auto", "auto_opti3dgs", "dash", "fast", "fast_30k", "fastgs", "gdgs", "mcmc", "mini"}
FAMILIES |= {"opti3dgs", "speedy", "steep", "taming"}
GROWTH = sorted(name for name in shipped() if name.removesuffix("_7k") in FAMILIES)
EWA = ["model.screen_filter={type: ewa, variance: 0.3}"]
MIP = ["model.screen_filter={type: mip, variance: 0.1}", "model.world_filter={type: smoothing, variance: 0.2}"]
BOX = ["model.screen_filter=box"]
MICRO = [
    "optimize.losses=[{type: l1, weight: 0.4}, {type: l2, weight: 4.0}, {type: dssim, weight: 0.2}, "
    "{type: covariance_trace, weight: 0.01, pixels: 64.0}]"
]


@pytest.mark.parametrize("name", GROWTH)
def test_each_takes_the_filters_and_the_losses_of_others(name):
    """Each pair is checked as a whole; the pixel's box has no conic, which some rules read."""
    for settings in (EWA, MIP, MICRO):
        load(name, settings)
    if name.removesuffix("_7k") in ("auto", "steep"):
        with pytest.raises(ConfigError, match="reads the inverse covariance"):
            load(name, BOX)
    else:
        load(name, BOX)


@pytest.mark.parametrize(
    ("name", "settings", "variance"),
    [("mcmc_7k", EWA, 0.3), ("steep_7k", MIP, 0.1), ("mini_7k", MICRO, 0.3)],
    ids=["mcmc with ewa", "steep with mip", "mini with micro"],
)
def test_three_of_them_train(name, settings, variance, tiny_scene, tmp_path):
    own = train(short(name, tiny_scene), tmp_path / "own")
    assert train(short(name, tiny_scene, *settings), tmp_path / "both") != own
    rendering = load_model(tmp_path / "both").rendering
    assert (rendering.screen_variance, rendering.compensate) == (pytest.approx(variance), float(settings is not MICRO))

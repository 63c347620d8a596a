"""Models with too large values: their renders are refused, not written as black images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.conformance.scenes import random_case
from clsplat.core.errors import DataError, NumericError
from tests.support.models import model_of

WORK = {
    "png": lambda file, scene, out: clsplat.render_views(file, scene, out),
    "npy": lambda file, scene, out: clsplat.render_views(file, scene, out, format="npy"),
    "evaluate": lambda file, scene, out: clsplat.evaluate(file, scene),
}


def save(path: Path, rng: np.random.Generator, value: float) -> Path:
    """Gaussians around the center of the scene, with coefficients of this size: of 3e38 a sixth overflow."""
    model = model_of(random_case(rng, 200))
    tables = {"means": rng.normal(0, 0.5, (200, 3)), "log_scales": np.full((200, 3), -2.0)}
    tables |= {"sh_base": value * rng.choice([-1, 1], (200, 3)), "sh_rest": value * rng.choice([-1, 1], (200, 45))}
    replace(model, **{name: table.astype(np.float32) for name, table in tables.items()}).save(path)
    return path


@pytest.mark.parametrize("work", WORK)
def test_nonfinite_image_is_refused_by_the_name_of_its_view(work, rng, tiny_scene, tmp_path):
    file = save(tmp_path / "m.ply", rng, 3e38)
    with pytest.raises(NumericError, match=r"^view 'test/r_000(\.png)?': the render is not finite.*too large"):
        WORK[work](file, tiny_scene, tmp_path / "out")
    assert not [path for path in (tmp_path / "out").rglob("*.*") if path.name != ".renders.json"]


@pytest.mark.parametrize("work", WORK)
def test_large_values_that_fit_are_shown(work, rng, tiny_scene, tmp_path):
    WORK[work](save(tmp_path / "m.ply", rng, 1e30), tiny_scene, tmp_path / "out")


@pytest.mark.parametrize("work", WORK)
def test_nonfinite_model_is_a_data_error(work, rng, tiny_scene, tmp_path):
    file = save(tmp_path / "m.ply", rng, float("nan"))
    with pytest.raises(DataError, match=r"sh_base, sh_rest have values that are not finite"):
        WORK[work](file, tiny_scene, tmp_path / "out")

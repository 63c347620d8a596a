"""Models for tests of formats, and the files of other programs."""

from pathlib import Path

import numpy as np
import pytest

from clsplat.formats.splats import PARAMETERS, Reading, SplatFile, Writing, opacities, unit
from clsplat.formats.table import read, write
from tests.data_sets import data_set


def interop(name: str) -> Path:
    """A file that another program wrote, or skip the test where it is missing."""
    path = data_set("splats") / "interop" / name
    if not path.exists():
        pytest.skip(f"no file {path}")
    return path


def splats(rng: np.random.Generator, count: int = 600, degree: int = 3, mode: str = "default") -> SplatFile:
    """Gaussians with values as trained ones have."""
    tables = {
        "means": rng.normal(0, 2, (count, 3)),
        "quats": rng.normal(0, 1, (count, 4)),
        "log_scales": rng.uniform(-8, 1, (count, 3)),
        "logit_opacity": rng.normal(0, 3, (count, 1)),
        "sh_base": rng.normal(0, 0.8, (count, 3)).clip(-3, 3),
        "sh_rest": rng.normal(0, 0.1, (count, 3 * ((degree + 1) ** 2 - 1))),
    }
    numbers = {"near": 0.05, "screen_variance": 0.1, "compensate": 1.0} if mode == "mip" else {}
    return SplatFile({name: table.astype(np.float32) for name, table in tables.items()}, numbers, mode)


def there_and_back(
    path: Path, source: SplatFile, options: Writing | None = None, reading: Reading | None = None
) -> SplatFile:
    """Write a model and read it."""
    write(path, source, options)
    return read(path, reading)


def angles(a: SplatFile, b: SplatFile) -> np.ndarray:
    """The angles between the rotations of two models, [N] degrees."""
    cosine = np.abs((unit(a.parameters["quats"]) * unit(b.parameters["quats"])).sum(axis=1))
    return np.degrees(2 * np.arccos(np.minimum(cosine, 1)))


def assert_close(found: SplatFile, expected: SplatFile, turned: float, **bounds: float) -> None:
    """Compare two models table by table: rotations in degrees, opacities in [0, 1], others in their own units."""
    a, b = found.parameters, expected.parameters
    assert list(a) == list(PARAMETERS)
    assert angles(found, expected).max() <= turned
    for name, bound in bounds.items():
        if name == "opacity":
            difference = np.abs(opacities(a["logit_opacity"]) - opacities(b["logit_opacity"]))
        else:
            assert a[name].shape == b[name].shape, name
            assert a[name].dtype == np.float32
            difference = np.abs(a[name].astype(np.float64) - b[name])
        assert difference.max(initial=0) <= bound, f"{name}: {difference.max()} > {bound}"

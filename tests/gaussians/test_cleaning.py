"""`clsplat convert` with `--filter-floaters`, `--level`, and `--sky`: it removes what it should, and little else."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import clsplat
from clsplat.core.errors import ConfigError, DataError
from clsplat.gaussians.conversion import COUNT, with_sky_splats, without_floaters
from clsplat.gaussians.model import Model
from clsplat.gaussians.sky import Sky
from tests.support.data_sets import data_set
from tests.support.models import interop


def room(rng: np.random.Generator) -> Model:
    """A sphere above a floor at y = 0.6."""
    sphere, floor = rng.normal(size=(2000, 3)), rng.uniform(-1, 1, (2000, 3))
    sphere *= 0.4 / np.linalg.norm(sphere, axis=1, keepdims=True)
    floor[:, 1] = 0.6 + rng.normal(0, 1e-3, 2000)
    return Model(
        np.concatenate([sphere, floor]),
        rng.normal(size=(4000, 4)),
        rng.normal(-3.5, 0.3, (4000, 3)),
        rng.normal(2, 1, (4000, 1)),
        rng.normal(size=(4000, 3)),
        rng.normal(0, 0.1, (4000, 9)),
    )


def plant(model: Model, rng: np.random.Generator, count: int) -> Model:
    """Append isolated pairs in empty space, large and faint Gaussians, and distant ones: `count` of each."""
    means = model.means.astype(np.float64)
    center, typical = np.median(means, axis=0), float(np.median(model.scales.max(axis=1)))
    distances = np.linalg.norm(means - center, axis=1)
    candidates = center + rng.uniform(-1.5, 1.5, (20_000, 3)) * np.quantile(distances, 0.99)
    gaps = cKDTree(means).query(candidates)[0]
    isolated = np.repeat(candidates[gaps > np.quantile(gaps, 0.6)][: (count + 1) // 2], 2, axis=0)[:count]
    large = means[rng.integers(len(model), size=count)] + rng.normal(0, typical, (count, 3))
    far = rng.normal(size=(count, 3))
    far *= rng.uniform(4, 40, (count, 1)) * np.quantile(distances, 0.99) / np.linalg.norm(far, axis=1, keepdims=True)
    tables = {name: np.repeat(table[:1], 3 * count, axis=0) for name, table in model.tables().items()}
    tables["means"] = np.concatenate([isolated + rng.normal(0, typical, (count, 3)), large, center + far])
    sizes = np.repeat([1.0, 20.0, 5.0], count)[:, None] * np.exp(rng.normal(0, 0.2, (3 * count, 3)))
    tables["log_scales"], tables["logit_opacity"] = np.log(typical * sizes), np.full((3 * count, 1), -2.0)
    return replace(model, **{name: np.concatenate([table, tables[name]]) for name, table in model.tables().items()})


def outdoors(rng: np.random.Generator) -> Model:
    """The room within a distant dome of large Gaussians, which are background."""
    dome, model = rng.normal(size=(1000, 3)), room(rng)
    tables = {name: np.concatenate([table, table[:1000]]) for name, table in model.tables().items()}
    tables["means"][4000:] = 30 * dome / np.linalg.norm(dome, axis=1, keepdims=True)
    tables["log_scales"][4000:] = np.log(2.0)
    return replace(model, **tables)


MODELS = {"room": room, "outdoors": outdoors, "robot": lambda rng: clsplat.load(interop("playbot31k.ply"))}


@pytest.mark.parametrize("name", list(MODELS))
def test_planted_floaters_are_found(name, rng, caplog):
    """Recall of each kind; what is removed in addition, compared with the model alone; and the logged counts."""
    caplog.set_level("INFO")
    model = MODELS[name](rng)
    count = len(model) // 100
    planted = plant(model, rng, count)
    number = np.arange(len(planted), dtype=np.float32)
    remaining = without_floaters(replace(planted, sh_base=np.column_stack([number] * 3))).sh_base[:, 0].astype(int)
    is_removed = np.ones(len(planted), bool)
    is_removed[remaining] = False
    recalls = [is_removed[len(model) + i * count :][:count].mean() for i in range(3)]
    # next to the dome, a planted Gaussian is not large
    assert min(recalls) >= {"room": 0.97, "outdoors": 0.8, "robot": 0.75}[name], recalls
    own_floaters = len(model) - len(without_floaters(model))
    assert own_floaters <= (0.01 if name == "robot" else 0.001) * len(model)
    assert is_removed[: len(model)].sum() <= own_floaters + 0.001 * len(model)
    numbers = [int(text.replace(",", "")) for text in re.findall(r"[\d,]*\d", caplog.messages[0])]
    assert numbers[0] == is_removed.sum() == sum(numbers[2:])


def test_models_without_touching_gaussians_are_rejected():
    with pytest.raises(DataError, match=r"8\d% of the Gaussians would be floaters"):
        without_floaters(clsplat.load(data_set("splats") / "train-1000.ply"))


def test_moving_models_need_a_time(rng):
    model = room(rng)
    motion = np.zeros((len(model), 5), np.float32)
    motion[:, 4] = 1
    with pytest.raises(ConfigError, match="--filter-floaters needs a static model"):
        without_floaters(replace(model, motion=motion))


def test_convert_cleans_and_levels(rng, tmp_path):
    turn = Rotation.from_euler("xz", [15, -20], degrees=True).as_matrix()
    plant(room(rng), rng, 20).transformed(3.0, turn, (5e5, 20, 4e6)).save(tmp_path / "a.ply")
    result = clsplat.convert(tmp_path / "a.ply", tmp_path / "b.ply", filter_floaters=True, level=True)
    assert result["gaussians"] < 4010
    model = clsplat.load(tmp_path / "b.ply")
    floor = model.means[2000:4000].astype(np.float64) + model.origin
    np.testing.assert_allclose(floor[:, 1], 0, atol=0.05)
    np.testing.assert_allclose(np.median(floor, axis=0)[[0, 2]], [5e5, 4e6], atol=3)


def assert_same_tables(actual: Model, expected: Model) -> None:
    for name, table in expected.tables().items():
        np.testing.assert_array_equal(getattr(actual, name), table, err_msg=name)


@pytest.mark.parametrize("source", ["sidecar", "splats"])
def test_sky_is_written_as_gaussians_or_removed(source, rng, tmp_path, caplog):
    model = replace(room(rng), sky=Sky(rng.random((64, 3)).astype(np.float32)))
    expected = with_sky_splats(model)
    (expected if source == "splats" else model).save(tmp_path / "a.ply")
    clsplat.convert(tmp_path / "a.ply", tmp_path / "c.ply", sky="splats")
    assert_same_tables(clsplat.load(tmp_path / "c.ply"), expected)
    clsplat.convert(tmp_path / "a.ply", tmp_path / "d.ply", sky="none")
    assert_same_tables(clsplat.load(tmp_path / "d.ply"), model)
    assert clsplat.load(tmp_path / "d.ply").sky is None
    assert not list(tmp_path.glob("[cd]_sky.json"))
    assert not caplog.text
    clsplat.convert(tmp_path / "a.ply", tmp_path / "e.ply", sky="splats", crop=(-1, -1, -1, 1, 0.5, 1))
    cropped = clsplat.load(tmp_path / "e.ply")
    assert len(cropped) - cropped.is_scene.sum() == COUNT
    assert 0 < cropped.is_scene.sum() < 4000


def test_missing_sky_is_an_error(rng, tmp_path):
    room(rng).save(tmp_path / "a.ply")
    with pytest.raises(ConfigError, match="--sky splats: the model has no sky; omit the option"):
        clsplat.convert(tmp_path / "a.ply", tmp_path / "b.ply", sky="splats")
    assert clsplat.convert(tmp_path / "a.ply", tmp_path / "b.ply", sky="none")["gaussians"] == 4000

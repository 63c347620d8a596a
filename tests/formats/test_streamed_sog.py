"""Streamed SOG: the layout of its JSON, leaves, and files, and damaged folders."""

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError, OutputError
from clsplat.core.files import new_folder
from clsplat.formats import streamed_sog
from clsplat.formats.packing import morton_order
from clsplat.formats.splats import SplatFile, WriteOptions, typical_size
from clsplat.formats.streamed_sog import LeafLimits, build_tree, half_boxes, write_lod
from clsplat.formats.table import detect, model_bytes, read, write
from clsplat.gaussians.conversion import convert
from clsplat.gaussians.model import load
from clsplat.gaussians.validate import examine, verdict
from clsplat.workflows.lod import build_levels
from tests.support.models import assert_close, interop, splats
from tests.support.runs import NO_PROCESS

BOUND = (-13.10682, -4.463487, -3.914306), (10.55131, 2.742857, 14.0425)  # of its root
SMALL = LeafLimits(splats=300, extent=4.0, min_splats=50)


def levels(rng: np.random.Generator, counts: tuple[int, ...] = (700, 300, 100)) -> list[SplatFile]:
    return [splats(rng, count, 1, "mip") for count in counts]


@pytest.fixture
def written(tmp_path: Path, rng: np.random.Generator) -> tuple[Path, list[SplatFile]]:
    made = levels(rng)
    write_lod(tmp_path / "site", made, WriteOptions(quality="high"), SMALL)
    return tmp_path / "site", made


def leaves(node: dict) -> list[dict]:
    return [node] if "lods" in node else [leaf for child in node["children"] for leaf in leaves(child)]


def test_meta_has_the_keys_of_the_specification(written):
    folder, _ = written
    meta = json.loads((folder / "lod-meta.json").read_text())
    assert meta["version"] == 1
    assert (meta["count"], meta["counts"], meta["lodLevels"]) == (1100, [700, 300, 100], 3)
    assert {name.split("/")[1] for name in meta["filenames"]} == {"meta.json"}
    assert {"0_0/meta.json", "0_1/meta.json", "1_0/meta.json", "2_0/meta.json"} <= set(meta["filenames"])
    nodes = [meta["tree"]]
    for node in nodes:
        assert node.keys() in ({"bound", "children"}, {"bound", "lods"})
        nodes += node.get("children", [])
        assert len(node.get("children", [0, 0])) == 2
        numbers = [*node["bound"]["min"], *node["bound"]["max"]]
        assert all(number == float(f"{number:.7g}") for number in numbers)


def test_each_leaf_is_a_morton_run_inside_its_box(written):
    """Runs fill their files without gaps, and the union of the leaves is the level."""
    folder, made = written
    meta = json.loads((folder / "lod-meta.json").read_text())
    files = [read(folder / name) for name in meta["filenames"]]
    ends, actual = dict.fromkeys(range(len(files)), 0), {level: [] for level in range(3)}
    for leaf in leaves(meta["tree"]):
        assert sum(run["count"] for run in leaf["lods"].values()) <= SMALL.splats
        low, high = np.array(leaf["bound"]["min"]), np.array(leaf["bound"]["max"])
        for level, run in leaf["lods"].items():
            assert meta["filenames"][run["file"]].startswith(f"{level}_")
            assert run["offset"] == ends[run["file"]], "one run follows the other"
            ends[run["file"]] += run["count"]
            means = files[run["file"]].parameters["means"][run["offset"] : ends[run["file"]]]
            assert (means >= low - 0.01).all()
            assert (means <= high + 0.01).all()
            actual[int(level)].append(means)
    assert ends == {file: len(part) for file, part in enumerate(files)}
    for level, source in enumerate(made):
        expected, means = source.parameters["means"], np.concatenate(actual[level])
        np.testing.assert_allclose(np.sort(means, axis=0), np.sort(expected, axis=0), atol=0.002)


def test_finest_level_is_read_back(written):
    folder, made = written
    for place in (folder, folder / "lod-meta.json"):
        result = read(place)
        assert (result.mode, result.rendering) == ("mip", made[0].rendering)
        assert len(load(place)) == 700
    assert detect(folder / "lod-meta.json").name == "streamed SOG"
    order = np.concatenate([leaf.rows[0] for leaf in build_tree([item.parameters for item in made], SMALL).leaves()])
    close = {"means": 0.002, "log_scales": 0.1, "opacity": 0.0101, "sh_base": 0.1, "sh_rest": 0.5}
    assert_close(result, made[0].rows(order), 0.8, **close)


def test_too_large_leaves_are_divided(rng):
    parameters = splats(rng, 700).parameters
    for limits in (SMALL, LeafLimits(100, 1e9, 1), LeafLimits(1000, 1.0, 20)):
        actual = list(build_tree([parameters], limits).leaves())
        for leaf in actual:
            span = np.ptp(parameters["means"][leaf.rows[0]], axis=0).max()
            assert len(leaf.rows[0]) <= limits.splats
            assert span <= limits.extent * typical_size(parameters["means"]) or len(leaf.rows[0]) <= limits.min_splats
            np.testing.assert_array_equal(morton_order(parameters["means"][leaf.rows[0]]), np.arange(len(leaf.rows[0])))
        np.testing.assert_array_equal(np.sort(np.concatenate([leaf.rows[0] for leaf in actual])), np.arange(700))


def test_box_covers_one_rotated_standard_deviation(rng):
    parameters = splats(rng, 50).parameters
    expected = np.empty((50, 3))
    for row, (quat, logs) in enumerate(zip(parameters["quats"], parameters["log_scales"], strict=True)):
        w, v = float(quat[0]), quat[1:].astype(np.float64)
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.exp(logs)
        length = w * w + v @ v
        turned = [(c * (w * w - v @ v) + 2 * v * (v @ c) + 2 * w * np.cross(v, c)) / length for c in corners]
        expected[row] = np.max(turned, axis=0)
    np.testing.assert_allclose(half_boxes(parameters), expected, rtol=1e-5)


def test_boxes_match_splat_transform(tmp_path):
    """The root's box of what its version 2.7.1 writes for this file as one level."""
    source = read(interop("train1000.ply"))
    write_lod(tmp_path / "a", [source])
    bound = json.loads((tmp_path / "a" / "lod-meta.json").read_text())["tree"]["bound"]
    np.testing.assert_allclose(bound["min"], BOUND[0], rtol=1e-6)
    np.testing.assert_allclose(bound["max"], BOUND[1], rtol=1e-6)


def test_same_levels_give_the_same_bytes(written, tmp_path, rng):
    folder, made = written
    assert write_lod(tmp_path / "again", made, WriteOptions(quality="high"), SMALL)
    files = {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    again = {p.relative_to(tmp_path / "again"): p.read_bytes() for p in (tmp_path / "again").rglob("*") if p.is_file()}
    assert files == again
    assert model_bytes(folder) == sum(map(len, files.values()))


def test_one_or_coincident_gaussians_make_levels(tmp_path, rng):
    first = splats(rng, 1)
    write_lod(tmp_path / "one", [first, first])
    assert len(read(tmp_path / "one")) == 1
    write_lod(tmp_path / "same", [first.rows(np.zeros(900, int))], limits=SMALL)
    assert len(read(tmp_path / "same")) == 900


def test_folder_appears_only_when_complete(tmp_path, rng, monkeypatch):
    made, calls, real = levels(rng), [], os.fsync

    def fsync(number):
        calls.append(number)
        if len(calls) == 30:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(number)

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(OutputError, match="No space left"), new_folder(tmp_path / "site") as place:
        write_lod(place, made, limits=SMALL)
    assert list(tmp_path.iterdir()) == []


def test_folder_in_use_is_refused(tmp_path, monkeypatch):
    for name in ("used/inner", "here", "empty"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to("empty")
    monkeypatch.chdir(tmp_path / "here")
    for place in (*(tmp_path / name for name in ("used", "file", "link")), Path()):
        with pytest.raises(ConfigError, match="already exists; use a new folder"), new_folder(place):
            pytest.fail("the work begins")


@pytest.mark.parametrize("name", ["file/x", "n" * 245])
def test_impossible_folder_is_refused_before_the_work(name, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="cannot be written"), new_folder(tmp_path / name):
        pytest.fail("the work begins")


def test_empty_folder_is_replaced_where_rename_cannot_replace(tmp_path, monkeypatch):
    """As on Windows."""

    def replace(old: Path, new: Path) -> None:
        if new.exists():
            raise PermissionError(errno.EACCES, "Access is denied")
        real(old, new)

    real = os.replace
    monkeypatch.setattr(os, "replace", replace)
    (tmp_path / "empty").mkdir()
    with new_folder(tmp_path / "empty") as place:
        (place / "a").write_text("x")
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")] == ["empty", "empty/a"]


def test_folders_of_killed_processes_are_removed_first(tmp_path):
    left = f".site.{NO_PROCESS}-0.partial"
    others = [f".other.{NO_PROCESS}-0.partial", f".site.{os.getppid()}-0.partial", ".site.partial"]
    for name in (left, *others):
        (tmp_path / name / "0_0").mkdir(parents=True)
    with new_folder(tmp_path / "site") as place:
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, place.name])
        with new_folder(tmp_path / "site.2"):
            pass
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, "site", "site.2"])


def test_empty_level_is_refused(written, tmp_path):
    _, made = written
    with pytest.raises(DataError, match="has no Gaussians"):
        write_lod(tmp_path / "b", [made[0], made[1].rows([])])
    with pytest.raises(ConfigError, match="streamed SOG is only written by `clsplat lod`"):
        write(tmp_path / "lod-meta.json", made[0])


def test_values_beyond_sog_are_refused_and_boxes_stay_finite(tmp_path, rng):
    large = splats(rng, 50)
    large.parameters["log_scales"][7] = 1000
    write_lod(tmp_path / "a", [large])
    json.loads((tmp_path / "a" / "lod-meta.json").read_text(), parse_constant=lambda text: pytest.fail(text))
    large.parameters["log_scales"][7] = 3e38
    write(tmp_path / "a.ply", large)
    told = r"1 of 50 Gaussians have log_scales beyond 1e\+15; SOG cannot store these"
    with pytest.raises(DataError, match=told):
        write_lod(tmp_path / "b", [large])
    with pytest.raises(DataError, match=told):
        build_levels(tmp_path / "a.ply", tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_environment_is_part_of_the_model(written, rng):
    folder, _ = written
    write(folder / "env" / "meta.json", splats(rng, 20, 2))
    meta = json.loads((folder / "lod-meta.json").read_text())
    (folder / "lod-meta.json").write_text(json.dumps({**meta, "environment": "env/meta.json"}))
    result = read(folder)
    assert (len(result), result.sh_degree) == (720, 2)


WRONG = {
    "another version": ({"version": 2}, "version 2; expected 1"),
    "no names": ({"filenames": None}, "filenames is None"),
    "a name twice": ({"filenames": ["0_0/meta.json", "0_0/meta.json"]}, "distinct file names"),
    "a name that leads out": ({"filenames": ["../meta.json"]}, "expected a meta.json in a subfolder"),
    "an absolute name": ({"filenames": ["/etc/meta.json"]}, "expected a meta.json in a subfolder"),
    "a NUL in a name": ({"filenames": ["0_0/meta.json", "\0/meta.json"]}, "expected a meta.json in a subfolder"),
    "a name that is no text": (
        {"filenames": ["0_0/meta.json", "\ud800/meta.json"]},
        "expected a meta.json in a subfolder",
    ),
    "a name of 5,000 letters": ({"filenames": [f"{'a' * 5000}/meta.json"]}, "expected a meta.json in a subfolder"),
    "a name of another file": ({"filenames": ["0_0/lod-meta.json"]}, "expected a meta.json in a subfolder"),
    "no such file": (
        {"filenames": [f"{i}_9/meta.json" for i in range(20)]},
        "_9/meta.json: cannot be read (No such file",
    ),
    "too few names": ({"filenames": []}, "refers to a missing file of level 0"),
    "no counts": ({"counts": []}, "expected a list with one number per level, for 1 to 64 levels"),
    "more levels than are declared": ({"lodLevels": 2}, "lodLevels is 2; expected 3, the length of counts"),
    "more levels than there can be": (
        {"counts": [0] * 65, "lodLevels": 65},
        "expected a list with one number per level, for 1 to 64 levels",
    ),
    "no number of levels": ({"lodLevels": None}, "lodLevels is None; expected 3"),
    "a level beyond": (
        {"counts": [700, 300], "lodLevels": 2},
        "a leaf refers to level '2'; expected 0 to 1",
    ),
    "another count": ({"counts": [701, 0, 0]}, "declares 701 splats of level 0, but its leaves have 700"),
    "no tree": ({"tree": 7}, "a node of its tree is 7"),
    "an empty tree": ({"tree": {"children": []}}, "have no file of level 0"),
    "no number": ({"tree": {"lods": {"0": {"file": 0, "offset": "0", "count": 1}}}}, "offset of a leaf is '0'"),
    "a negative number": ({"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": -1}}}}, "count of a leaf is -1"),
    "beyond its file": ({"tree": {"lods": {"0": {"file": 0, "offset": 10**6, "count": 1}}}}, "expected splats from 0"),
    "more than its files hold": (
        {"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 10**8}}}},
        "declares 100000000 splats, but its files have only",
    ),
    "a file twice": ({"filenames": ["0_0/meta.json", "0_0//meta.json"]}, "expected distinct file names"),
    "a run twice": (
        {"tree": {"children": [{"lods": {"0": {"file": 0, "offset": 0, "count": 9}}}] * 2}},
        "no other leaf",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_damaged_model_is_refused_in_one_line(written, name):
    folder, _ = written
    change, message = WRONG[name]
    meta = json.loads((folder / "lod-meta.json").read_text())
    (folder / "lod-meta.json").write_text(json.dumps({**meta, **change}))
    with pytest.raises(DataError) as error:
        read(folder)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < len(str(folder)) + 300


def test_tree_is_traversed_once_for_all_levels(written, monkeypatch):
    folder, _ = written
    walks, real = [], streamed_sog._iterate_leaves
    monkeypatch.setattr(streamed_sog, "_iterate_leaves", lambda path, tree: walks.append(path) or real(path, tree))
    assert streamed_sog.find_level_faults(folder / "lod-meta.json") == []
    assert len(walks) == 1


def renamed(folder: Path, file: int, name: str) -> Path:
    """Give a file of the levels another name, in their JSON alone; return its path under the old name."""
    path = folder / "lod-meta.json"
    meta = json.loads(path.read_text())
    old, meta["filenames"][file] = meta["filenames"][file], name
    path.write_text(json.dumps(meta))
    return folder / old


def test_missing_coarser_level_is_damage(written, tmp_path):
    folder, _ = written
    renamed(folder, 1, "9_9/meta.json")
    assert len(read(folder)) == 700
    with pytest.raises(
        DataError, match=r"lod-meta\.json: names '.*9_9/meta\.json', which cannot be read \(No such file"
    ):
        convert([folder], tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()


def test_check_names_each_missing_or_damaged_level_file(written):
    folder, _ = written
    assert examine(folder)["valid"]
    path = folder / "lod-meta.json"
    meta = json.loads(path.read_text())
    coarse = [name for name in meta["filenames"] if not name.startswith("0_")]
    shutil.rmtree(folder / coarse[0].split("/")[0])
    next((folder / coarse[1]).parent.glob("scales*.webp")).write_bytes(b"RIFF")
    meta["counts"][2] += 1
    path.write_text(json.dumps({**meta, "filenames": [*meta["filenames"], "more/meta.json"]}))
    result = examine(folder)
    assert not result["valid"]
    missing, damaged, count, spare = result["findings"]
    assert missing.startswith(f"{folder / coarse[0]}: cannot be read (No such file")
    assert str(folder / coarse[1]) in damaged
    assert "splats of level 2, but its leaves have 100" in count
    assert spare.startswith(f"{folder / 'more'}")
    assert verdict(result).endswith("; write it again")

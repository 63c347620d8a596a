"""Commands with an output path: no photograph, model, or file of a run is replaced."""

import shutil
from pathlib import Path

import pytest

import clsplat
from tests.support.commands import clsplat as command

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return clsplat.run("smoke", tiny_scene, tmp_path_factory.mktemp("runs") / "run", set={"optimize.steps": 4})


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("place", [".", "test", "test/new", ".."])
def test_renders_are_not_written_among_photographs(place, finished, tiny_scene, tmp_path):
    scene = tmp_path / "scene"
    shutil.copytree(tiny_scene, scene)
    before = contents(tmp_path)
    said = command("render", finished, "--scene", scene, "--out", scene / place, expect=2).stderr
    assert "the folder of the photos" in said
    assert contents(tmp_path) == before


def test_renders_replace_only_renders(finished, tmp_path):
    out = tmp_path / "images"
    command("render", finished, "--out", out)
    image = next(out.rglob("*.png"))
    data = image.read_bytes()
    image.write_bytes(b"")
    command("render", finished, "--out", out)
    assert image.read_bytes() == data
    (tmp_path / "other" / image.relative_to(out)).parent.mkdir(parents=True)
    (tmp_path / "other" / image.relative_to(out)).write_bytes(b"a drawing")
    said = command("render", finished, "--out", tmp_path / "other", expect=2).stderr
    assert f"{tmp_path / 'other' / image.relative_to(out)}: exists" in said
    assert command("render", finished, "--out", finished / "renders", expect=2)
    assert clsplat.check(finished)["whole"]


@pytest.mark.parametrize(
    ("before", "name", "expected"),
    [
        (["compare", "RUN", "--out"], "point_cloud.ply", "use a file name that ends in .html"),
        (["compare", "RUN", "--out"], "report.html", "is a file of a run"),
        (["inspect", "SCENE", "--html"], "point_cloud.ply", "use a file name that ends in .html"),
        (["inspect", "SCENE", "--html"], "report.html", "is a file of a run"),
        (["evaluate", "RUN", "--out"], "point_cloud.ply", "use a file name that ends in .json"),
        (["evaluate", "RUN", "--out"], "metrics.json", "is a file of a run"),
    ],
)
def test_files_of_a_run_are_not_replaced(before, name, expected, finished, tiny_scene):
    kept = (finished / name).read_bytes()
    words = [{"RUN": finished, "SCENE": tiny_scene}.get(word, word) for word in before]
    assert expected in command(*words, finished / name, expect=2).stderr
    assert (finished / name).read_bytes() == kept

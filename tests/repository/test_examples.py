"""Every example and the Python code of the documentation run; test_plugins.py tests the plug-ins."""

import ast
import inspect
import json
import operator
import re
import runpy
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import clsplat
from clsplat import cli
from clsplat.conformance.scenes import random_case
from clsplat.density.edit import Edit
from clsplat.density.statistics import SplatStats
from clsplat.density.survey import Survey
from clsplat.density.thresholds import SceneScale
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import load_experiment
from clsplat.pipeline.yaml_file import read_yaml
from tests.support.html_page import Page

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
VERBS = ("mark", "choose", "set_rows", "set_children")
TESTED = {  # where
    **dict.fromkeys(("box_blur.py", "opacity_entropy.py"), "pipeline/test_plugins.py"),
    "csv_reader.py": "scene/test_csv_reader.py",
    "random_pruning.py": "pipeline/test_plugins.py",
    "learned_cameras.yaml": "training/test_learned_cameras.py",
    "lens_and_curves.py": "training/test_lens_and_curves.py",
    "test_opacity_entropy.py": "repository/test_docs.py",
}
PAGES = ("README.md", "docs/python.md")


@pytest.fixture
def folder(tiny_scene, tmp_path, monkeypatch) -> Path:
    """A folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def python_lines() -> list[tuple[str, str]]:
    """Blocks of Python, with the page's name."""
    pattern = re.compile(r"^```python\n(.*?)^```", re.M | re.S)
    return [(page, code) for page in PAGES for code in pattern.findall((ROOT / page).read_text())]


def test_every_example_has_a_test():
    own = Path(__file__).read_text()
    for path in EXAMPLES.iterdir():
        if path.suffix in (".py", ".yaml", ".ipynb"):
            text = (ROOT / "tests" / TESTED[path.name]).read_text() if path.name in TESTED else own
            assert path.stem in text, f"{path.name} has no test"


def test_own_loss_gradient_matches_differences(rng):
    edges = runpy.run_path(str(EXAMPLES / "own_loss.py"))["edge_loss"]
    image, photograph, direction = rng.uniform(size=(3, 7, 5, 3))
    _, derivative = edges(image, photograph)
    up, down = (edges(image + sign * 1e-6 * direction, photograph)[0] for sign in (1, -1))
    assert float((derivative * direction).sum()) == pytest.approx((up - down) / 2e-6, rel=1e-6)


def test_own_loss_trains(tiny_scene, folder, monkeypatch, capsys):
    pipeline = Path(folder / "short.yaml")
    pipeline.write_text(load("smoke", ["optimize.steps=100"]).text())
    monkeypatch.setattr(sys, "argv", ["own_loss.py", str(tiny_scene), str(pipeline)])
    runpy.run_path(str(EXAMPLES / "own_loss.py"), run_name="__main__")
    assert "step 100: loss 0." in capsys.readouterr().out
    own = clsplat.load("own_loss.ply")
    plain = clsplat.Trainer(tiny_scene, pipeline)
    plain.run()
    assert len(own) != len(plain.model) or (own.means != plain.model.means).any()


def test_render_service_answers_with_pictures(tiny_scene, folder):
    assert len((EXAMPLES / "render_service.py").read_text().splitlines()) <= 30
    trainer = clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 5})
    trainer.run()
    trainer.model.save("model.ply")
    command = [sys.executable, EXAMPLES / "render_service.py", "model.ply", tiny_scene, "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as service:
        try:
            address = service.stdout.readline().strip()
            view = trainer.scene.split("test")[0]

            def picture(query: str) -> np.ndarray:
                with urllib.request.urlopen(f"{address}?{query}", timeout=60) as answer:
                    assert answer.headers["Content-Type"] == "image/png"
                    return cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_COLOR)

            expected = clsplat.Renderer(trainer.model).render(view).png()
            named = picture(f"view={view.name}")
            np.testing.assert_array_equal(named, cv2.imdecode(np.frombuffer(expected, np.uint8), cv2.IMREAD_COLOR))
            x, y, z = view.position
            assert picture(f"x={x}&y={y}&z={z}").shape == (40, 40, 3)
            for query in ("", "view=%0d%0aX:1", "x=1&y=2", "x=nan&y=0&z=0", "x=one&y=0&z=0"):
                with pytest.raises(urllib.error.HTTPError, match="400") as error:
                    picture(query)
                error.value.close()
        finally:
            service.kill()


def test_scene_to_picture_notebook_runs(tiny_scene, folder):
    """Cells as a notebook takes them: the value of a last line is shown."""
    notebook = json.loads((EXAMPLES / "scene_to_picture.ipynb").read_text())
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    codes = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] or cell["execution_count"] for cell in codes), "commit it without outputs"
    shutil.copytree(tiny_scene, "demo_scene")
    names, shown = {}, []
    for number, cell in enumerate(codes):
        tree = ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"cell {number}", "exec"), names)
        value = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names) if last else None
        if hasattr(value, "_repr_html_"):
            Page(value._repr_html_())
        elif hasattr(value, "_repr_png_"):
            assert value._repr_png_().startswith(b"\x89PNG")
        shown.append(type(value).__name__)
    assert shown == ["Scene", "dict", "Model", "RenderResult", "RenderResult", "Model", "Model"]
    assert clsplat.metrics.psnr(names["result"].image, names["view"].photograph(1.0)) > 20
    assert Path("scene_to_picture.ply").is_file()


def test_both_pages_have_python_code():
    assert {page for page, _ in python_lines()} == set(PAGES)


SMALLER = {"640, 480, 500, 500, 320, 240": "64, 48, 50, 50, 32, 24", "480, 640": "48, 64"}  # cameras and images, px


@pytest.mark.parametrize(("page", "code"), python_lines(), ids=lambda text: text.partition("\n")[0])
def test_documented_python_code_runs(page, code, tiny_scene, folder):
    if "clsplat.torch" in code:
        pytest.importorskip("torch")
    code, scenes = re.subn(r'"data/\w+"', repr(str(tiny_scene)), code)
    code, steps = re.subn(r'"optimize.steps": \d+', '"optimize.steps": 20', code)
    code, sizes = re.subn(r"640, 480, 500, 500, 320, 240|480, 640", lambda m: SMALLER[m[0]], code)
    assert scenes == 1 or sizes == 2, "what is replaced is not there"
    assert steps == code.count("optimize.steps")
    exec(compile(code, page, "exec"), {})
    assert len(list(folder.glob("*.ply"))) == code.count(".save(")


def test_growth_methods_are_compared_at_equal_length_and_seeds():
    experiment = load_experiment(str(EXAMPLES / "growth.yaml"))
    assert {cell.pipeline.settings.training.steps for cell in experiment.cells} == {2000}
    names = [cell.pipeline.settings.name for cell in experiment.cells]
    assert {"splat_7k", "dash_7k", "mcmc_7k", "steep_7k"} <= set(names)
    assert {names.count(name) for name in names} == {3}
    page = (EXAMPLES.parent / "docs" / "growth.md").read_text()
    assert all(f"`{name}`" in page or f"`{name.removesuffix('_7k')}`" in page for name in names)


def test_captures_are_compared_with_the_same_cameras(folder):
    for name in read_yaml(EXAMPLES / "captures.yaml").data["matrix"]["scenes"]:
        (folder / name).mkdir(parents=True)
    cells = load_experiment(str(EXAMPLES / "captures.yaml"), ["undistort.long_side=400"]).cells
    assert len(cells) == 36
    steps = [[step.model_dump() for step in cell.pipeline.settings.prepare] for cell in cells]
    assert steps == [steps[0]] * 36
    assert steps[0][-1]["long_side"] == 400


def test_growing_resolution_is_a_pipeline():
    resolution = load(str(EXAMPLES / "growing_resolution.yaml")).settings.stages[1].views.resolution
    assert resolution.points == [[0, 4.0], [500, 2.0], [1000, 1.0]]
    assert [resolution.at(step) for step in (1, 499, 500, 999, 1000, 2000)] == [4, 4, 2, 2, 1, 1]


def test_growing_resolution_trains_at_its_sizes(tiny_scene, tmp_path):
    """Up to step 500 the size is that of `resolution: 4`, and not the full one."""
    written = {}
    for name, setting in {"own": "", "quarter": "4.0", "full": "1.0"}.items():
        sets = ["optimize.steps=6", "optimize.during=[]"] + [f"optimize.views.resolution={setting}"] * bool(setting)
        arguments = [part for text in sets for part in ("--set", text)]
        out = tmp_path / name
        command = ["run", str(EXAMPLES / "growing_resolution.yaml"), "--scene", str(tiny_scene), "--out", str(out)]
        done = CliRunner().invoke(cli.app, [*command, *arguments])
        assert done.exit_code == 0, done.output
        written[name] = (out / "point_cloud.ply").read_bytes()
    assert written["own"] == written["quarter"]
    assert written["own"] != written["full"]


@pytest.mark.parametrize(("name", "limit"), [("opacity_entropy", 25), ("box_blur", 40), ("csv_reader", 35)])
def test_example_is_short(name, limit):
    assert len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= limit


def test_blur_and_its_kernel_are_short():
    lines = [line.strip() for suffix in ("py", "cl") for line in (EXAMPLES / f"box_blur.{suffix}").open()]
    code = [line for line in lines if line and not line.startswith(('"""', "/*", "*"))]
    assert len(code) <= 40


def test_documented_edit_methods_match_the_class():
    """Each `edit.name` of the page exists, and so do the arguments that the table gives to it."""
    gaussians = random_case(np.random.default_rng(0), 3).model(clsplat.Device()).gaussians
    edit = Edit(gaussians, SplatStats(gaussians), SceneScale(1.0), 1, 0, Survey(None, None, None, [], 0, 1))
    page = (ROOT / "docs" / "plugin_examples.md").read_text()
    matches = re.findall(r"`edit\.([\w.]+)(?:\(([^)`]*)\))?", page)
    assert {name for name, _ in matches} >= {"mark", "choose", "set_rows", "room", "scene_scale.extent"}
    for name, arguments in matches:
        verb = operator.attrgetter(name)(edit)
        if arguments:
            known = inspect.signature(verb).parameters
            named = [part for part in re.findall(r"[a-z_]+", arguments) if name in VERBS]
            assert set(named) <= set(known), f"edit.{name}"

"""What a run writes is reserved for it, and read back at its end."""

import ast
from pathlib import Path
from typing import Any

import pytest

from clsplat import names
from clsplat.errors import OutputError
from clsplat.pipeline.loading import load
from clsplat.runs import opening, outputs, runner
from clsplat.scene.images import write_image
from clsplat.stages.render import image_paths
from clsplat.training.run import Run


@pytest.mark.slow
def test_what_a_run_writes_itself_is_on_the_table_of_reserved_names(finished):
    pipeline, run = finished
    chosen = {path for stage in pipeline.stages for path in stage.outputs(run.out)}
    made = {path.name for path in run.out.iterdir()} - {path.relative_to(run.out).parts[0] for path in chosen}
    assert {"status.json", "metrics.jsonl", "checksums.json"} <= made
    assert made <= names.RESERVED


def test_names_of_files_of_a_run_stand_in_one_table_and_are_reserved():
    table = {value for name, value in vars(names).items() if name.isupper() and isinstance(value, str)}
    assert {"pipeline.yaml", "run.lock", "compare.html", "undistorted"} < table <= names.RESERVED
    package = Path(names.__file__).parent
    for file in package.rglob("*.py"):
        if file.parent.name in ("api", "cli") or file.name == "names.py":  # of a page that is no run's
            continue
        texts = {node.value for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Constant)}
        assert not texts & table, file


def test_views_that_differ_in_their_suffix_have_a_render_each():
    names = ["a.jpg", "a.png", "b/a.jpg", "c.jpg", "d"]
    files = [path.as_posix() for path in image_paths(Path("r"), names)]
    assert files == ["r/a.jpg.png", "r/a.png.png", "r/b/a.png", "r/c.png", "r/d.png"]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGE = {
    "a render is missing": ("renders/FIRST", Path.unlink),
    "a render is cut": ("renders/LAST", truncate),
    "a render is of another size": ("renders/LAST", None),
    "the report is cut": ("report.html", truncate),
    "the metrics are cut": ("metrics.json", truncate),
    "the model is missing": ("point_cloud.ply", Path.unlink),
}


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Run]:
    out = tmp_path_factory.mktemp("outputs") / "run"
    checked = load("smoke", [f"scene.path='{tiny_scene}'", "optimize.steps=3", "optimize.during=[]"])
    run = opening.open_run(checked, out, None)
    runner.execute(checked, run, "new", lambda progress: None)
    return checked, run


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGE)
def test_what_cannot_be_read_back_is_no_success(name, finished):
    pipeline, run = finished
    place, damage = DAMAGE[name]
    renders = sorted((run.out / "renders").rglob("*.png"))
    file = {"renders/FIRST": renders[0], "renders/LAST": renders[-1]}.get(place, run.out / place)
    before = file.read_bytes()
    try:
        if damage:
            damage(file)
        else:
            import numpy as np

            write_image(file, np.zeros((3, 3, 3), np.uint8))
        with pytest.raises(OutputError, match=f"{file.name}.*at the end of the run; see .*log.txt"):
            outputs.check_outputs(pipeline, run)
    finally:
        file.write_bytes(before)
    outputs.check_outputs(pipeline, run)

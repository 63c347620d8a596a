"""A pipeline, even an untrusted one, writes only inside its run folder."""

import json
import typing
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from clsplat.core import files
from clsplat.core.errors import ConfigError
from clsplat.core.settings import TAGS, Settings, VariantName
from clsplat.pipeline.execution import Execution
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import Matrix, MatrixFile, load_experiment
from clsplat.training.run import Run
from clsplat.training.stage import Stage, path_in_run

READ = {  # text that is read, or compared, and never the name of something that is written
    "Auto.reason", "Appearance.reason", "BilateralGrid.reason", "Exposure.reason",
    "Adaptation.keep", "Photos.keep", "Decision.key", "Decision.reason",
    "SceneSettings.path", "Init.file", "Evaluate.file", "Evaluate.lpips", "Matrix.pipelines", "Matrix.scenes",
    "SceneSettings.masks", "InverseDepth.folder",
    "Matrix.set", "Matrix.options", "PipelineFile.plugins", "Snapshot.view", "Snapshot.size", "Timelapse.folder",
    "Video.path", "Video.size", "ViewSelection.names", "ViewSelection.file", "Execution.engine",
    "LocalExecution.engine", "LocalExecution.devices", "Execution.devices", "Tls.ca", "Tls.cert", "Tls.key",
}  # fmt: skip
NAMES = {"PipelineFile.name", "MatrixFile.name", "Execution.store"}  # of folders
OUTSIDE = [
    "", ".", "./", "..", "../x", "a/../../x", "a/..", "..\\x", "a\\..\\..\\x", "/x", "//host/share/x", "\\x",
    "\\\\h\\s\\x",
    "C:/x", "C:x", "c:\\x", "~\u0000/x", "a\u0000b", "a\nb", "a\u007f", "\ud800", "x" * 300, "x" * 201, "é" * 101,
    "a/" + "x" * 300,
    "con", "NUL", "a/Aux.png", "com1", "LPT9.x", "COM¹", "CONOUT$", "a.", "a ", "a/b. /c", "CHECKP~1",
    "a:b", "a*", "a?", "a|b", "a<b", 'a"b', ".hidden", "a/.git/hooks", "checkpoints", "Checkpoints/x", "CHECKPOINTS",
    "undistorted", "prepared", "status.json", "status.json/x", "Pipeline.YAML", "metrics.json", "metrics.jsonl",
    "trial.jsonl", "log.txt", "LOG.TXT", "run.lock", "inputs.json", "checksums.json", "prepared.json",
]  # fmt: skip
INSIDE = ["renders", "a/b", "a b", "a.b", "réndérs", "x" * 180, "console", "a~b", "status", "b/status.json", "a..b"]


def text_fields() -> list[tuple[type[Settings], str]]:
    """The fields of all settings in the package that hold text of one's own."""

    def of_text(kind: Any) -> bool:
        if typing.get_origin(kind) is Literal:
            return False
        return kind is str or (isinstance(kind, type) and issubclass(kind, Path)) or any(map(of_text, _inner(kind)))

    def _inner(kind: Any) -> tuple[Any, ...]:
        marks = getattr(kind, "__metadata__", ())
        return () if any(isinstance(mark, VariantName) for mark in marks) else typing.get_args(kind)

    own = [kind for kind in Settings.subclasses if kind.__module__.startswith("clsplat.")]
    return [
        (kind, name)
        for kind in [*own, PipelineFile, Matrix, MatrixFile]
        for name, field in kind.model_fields.items()
        if name not in TAGS
        and of_text(field.annotation)
        and not any(isinstance(mark, VariantName) for mark in field.metadata)
    ]


def test_every_string_setting_is_an_input_or_checked_output():
    actual = {f"{kind.__name__}.{name}" for kind, name in text_fields()}
    assert Execution in Settings.subclasses
    checked = {
        f"{kind.__name__}.{n}" for kind, n in text_fields() if issubclass(kind, Stage) and n in kind.named_outputs()
    }
    assert {"Export.file", "Render.folder", "HtmlReport.file"} <= checked
    assert actual == READ | NAMES | checked, "a new text: check it with path_in_run, or list it as one that is read"


WRITING = [kind for kind in Settings.subclasses if issubclass(kind, Stage) and kind.named_outputs()]


@pytest.mark.parametrize("kind", WRITING, ids=lambda kind: kind.__name__)
def test_stages_cannot_write_outside_or_over_records(kind):
    for field, suffixes in kind.named_outputs().items():
        suffix = next(iter(suffixes), "")
        for path in OUTSIDE:
            for text in {path, path + suffix} - ({"~\u0000/x"} if suffix else set()):
                if suffix and text != path and files.invalid_output_reason(text) is None:
                    continue  # another name, which is allowed
                with pytest.raises(ValueError, match="cannot write to this path"):
                    kind.model_validate({field: text})
        for path in INSIDE:
            kind.model_validate({field: path + suffix})


@pytest.mark.parametrize(
    ("place", "text"), [("scene.path", "a\\0b"), ("init.file", "\\ud800"), ("evaluate.lpips", "a\\0b")]
)
def test_impossible_paths_are_refused_when_read(place, text):
    with pytest.raises(ConfigError, match="a path without NUL characters and with valid Unicode"):
        load("smoke", [f'{place}="{text}"'])


@pytest.mark.parametrize("name", ["..", "a/b", "x" * 300, "NUL.txt", "a.", ""])
def test_pipeline_name_is_a_valid_folder_name(name):
    with pytest.raises(ConfigError, match=r"--set name=.*: expected"):
        load("smoke", [f"name={json.dumps(name)}"])


def matrix(tmp_path: Path, *scenes: str) -> Path:
    file = tmp_path / "matrix.yaml"
    stages = "stages: [{init: {}}, {optimize: {steps: 1, losses: [l1]}}]"
    file.write_text(f"name: m\nmatrix: {{scenes: {list(scenes)}}}\n{stages}\n")
    return file


@pytest.mark.parametrize("scene", ["..", "a/..", "checkpoints", "y/" + "z" * 240])
def test_matrix_cell_is_inside_the_folder(scene, tmp_path):
    with pytest.raises(ConfigError, match="a cell of the matrix would be named"):
        load_experiment(str(matrix(tmp_path, scene)))


CLASHES = {
    "two exports": ("[export, export]", "point_cloud.ply"),
    "names that differ in case": ("[{export: {file: a.ply}}, {export: {file: A.ply}}]", "a.ply"),
    "the raw file of another export": ("[{export: {file: a.ply}}, {export: {file: a_raw.ply}}]", "a_raw.ply"),
    "a file and a folder": ("[export, {render: {folder: point_cloud.ply}}]", "point_cloud.ply"),
    "a file below a file": ("[evaluate, {report: {file: a.html}}, {export: {file: a.html/a.ply}}]", "a.html/a.ply"),
}


@pytest.mark.parametrize("name", CLASHES)
def test_two_stages_writing_one_file_are_refused(name, tmp_path):
    stages, clash = CLASHES[name]
    with pytest.raises(ConfigError, match=f"two stages write '{clash}'; change the file name in one of them"):
        load(str(pipeline(tmp_path, stages)))


def test_two_renders_may_share_a_folder(tmp_path):
    load(str(pipeline(tmp_path, "[render, {render: {split: train}}, {export: {file: renders/a.ply}}]")))


def pipeline(tmp_path: Path, last: str) -> Path:
    first = "{init: {count: 50, source: random}}, {optimize: {steps: 1, losses: [l1]}}"
    file = tmp_path / "pipeline.yaml"
    file.write_text(f"name: outputs\nstages: [{first}, {last.strip('[]')}]\n")
    return file


def test_optional_output_field_of_a_plugin_is_checked():
    defined = list(Settings.subclasses)

    class Animate(Stage):
        stage: Literal["animate"] = "animate"
        video: Annotated[str, path_in_run(".mp4")] | None = None

        def run(self, run: Run) -> None: ...

    Settings.subclasses[:] = defined
    assert Animate.named_outputs() == {"video": (".mp4",)}
    assert Animate().outputs(Path("run")) == []
    assert Animate(video="a/b.mp4").outputs(Path("run")) == [Path("run/a/b.mp4")]
    with pytest.raises(ValueError, match=r"does not end in \.mp4"):
        Animate(video="status.html")

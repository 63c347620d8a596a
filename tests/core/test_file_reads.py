"""Only `clsplat.core.reading` reads files, and only regular ones."""

import ast
import json
import os
from pathlib import Path

import pytest

import clsplat
from clsplat.core.errors import ClsplatError, ConfigError, DataError
from clsplat.core.manifest import Manifest, hash_values
from clsplat.data_tools.video import write_frames
from clsplat.pipeline import recipes
from clsplat.pipeline.matrix import load_experiment
from clsplat.pipeline.plugins import hash_plugin_files
from clsplat.runs.status import summarize_run
from clsplat.scene import identity
from clsplat.training import archive
from tests.support.timeouts import failing

ROOT = Path(__file__).parents[2]
METHODS = {"read_text", "read_bytes", "file_digest"}
FUNCTIONS = {"json.load", "np.load", "np.fromfile", "cv2.imread", "cv2.VideoCapture", "os.open", "tarfile.open"}
FUNCTIONS |= {"zipfile.ZipFile"}
ALLOWED = {  # module and function -> why it reads by itself
    "clsplat/core/reading.py:open_regular": "the place where files are opened",
    "clsplat/core/reading.py:sha256": "the place where they are hashed",
    "clsplat/core/signals.py": "opens the null device",
    "clsplat/core/files.py:_sync": "syncs what was written",
    "clsplat/training/archive.py:read": "takes a file that `regular` has opened",
    "clsplat/training/archive.py:write": "writes",
    "clsplat/core/lock.py:check_free": "locks what it opens",
    "clsplat/core/lock.py:_open_lock_file": "opens for writing too",
    "clsplat/formats/sog.py:open_sog": "takes the bytes that `reading` has read",
    "clsplat/formats/sog.py:_zip": "writes",
    "clsplat/formats/usd.py:_read_layer": "takes the bytes that `reading` has read",
    "clsplat/formats/usd.py:write_usd": "writes",
    "clsplat/viewer/video/encoding.py:open_video": "syncs what it has written",
    "clsplat/viewer/video/encoding.py:count_frames": "decodes what was written before",
    "clsplat/viewer/video/encoding.py:fix_track_ids": "changes what was written before",
    "clsplat/pipeline/files.py:shipped_pipelines": "reads files of the package",
    "clsplat/viewer/page.py": "reads files of the package",
    "clsplat/runs/live/server.py": "reads files of the package",
    "clsplat/conformance/quick.py:_hash_files": "reads files of the package",
    "clsplat/opencl/device.py": "reads kernels, of the package and of plug-ins: code that is trusted",
    "clsplat/opencl/runtimes.py": "reads files of the system's loader, before clsplat can be imported",
    "clsplat/core/machine.py:available_memory": "reads what the kernel tells, which has no size",
    "data_tools/video.py:decode_frames": "decodes what was hashed before",
    "data_tools/lpips.py:write_lpips": "unpacks a package whose hash was checked",
    "data_tools/fetch.py:_open_members": "unpacks what it has downloaded",
}


def read_by(call: ast.Call) -> bool:
    """Return whether a call opens a file for reading."""
    name = ast.unparse(call.func)
    if name in FUNCTIONS or (isinstance(call.func, ast.Attribute) and call.func.attr in METHODS):
        return True
    mode = call.args[name == "open" :][:1] + [keyword.value for keyword in call.keywords if keyword.arg == "mode"]
    reads = not mode or (isinstance(mode[0], ast.Constant) and str(mode[0].value).startswith("r"))
    return (name == "open" or name.endswith(".open")) and reads and not (call.args[1:] and name != "open")


def reads(path: Path) -> set[str]:
    """Where a module reads files: 'module:function', of the innermost function."""
    actual = set()

    def visit(node: ast.AST, function: str) -> None:
        if isinstance(node, ast.FunctionDef):
            function = node.name
        if isinstance(node, ast.Call) and read_by(node):
            actual.add(f"{path.relative_to(ROOT).as_posix()}:{function}")
        for child in ast.iter_child_nodes(node):
            visit(child, function)

    visit(ast.parse(path.read_text("utf-8")), "")
    return actual


def test_files_are_read_only_by_the_read_module():
    actual = {one for room in ("clsplat", "data_tools") for path in (ROOT / room).rglob("*.py") for one in reads(path)}
    known = {one for one in actual for place in ALLOWED if one == place or one.startswith(f"{place}:")}
    assert sorted(actual - known) == [], "read with clsplat.core.reading, or say in ALLOWED why not"
    unused = [place for place in ALLOWED if not any(one == place or one.startswith(f"{place}:") for one in actual)]
    assert unused == [], "is not needed any more"


@pytest.mark.parametrize(
    "text", ["p.open()", "p.open('rb')", "open(p)", "open(p, 'r')", "p.read_text()", "json.load(f)", "p.open(mode='r')"]
)
def test_search_finds_reads(text):
    assert read_by(ast.parse(text).body[0].value)


@pytest.mark.parametrize("text", ["p.open('wb')", "open(p, 'a')", "json.loads(s)", "open_device()", "Job.open(a, b)"])
def test_search_ignores_other_calls(text):
    assert not read_by(ast.parse(text).body[0].value)


# ---- what is no regular file, or no text


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


READERS = {
    "a pipeline to copy": (lambda path: recipes.copy(str(path), path.with_name("copy.yaml")), ConfigError),
    "a matrix": (lambda path: load_experiment(str(path)), ConfigError),
    "a plug-in": (hash_plugin_files, ConfigError),
    "a video": (lambda path: write_frames(path, path.with_name("frames"), 2), DataError),
    "a file that is hashed": (hash_values, DataError),
    "a checkpoint": (archive.read, ClsplatError),
}


@pytest.mark.parametrize("name", READERS)
def test_pipe_is_refused_at_once(name, pipe):
    read, kind = READERS[name]
    with failing("the reader waits", seconds=20), pytest.raises(kind, match="it is a pipe"):
        read(pipe)


def test_records_that_are_pipes_count_as_missing(pipe, tmp_path, monkeypatch, caplog):
    with failing("the reader waits", seconds=20):
        pipe.rename(tmp_path / ".manifest.jsonl")
        assert not Manifest(tmp_path).has_entry(tmp_path / "x.png")
        os.mkfifo(tmp_path / "known.txt")
        monkeypatch.setattr(identity, "cache_folder", lambda: tmp_path)
        (tmp_path / "decoded").mkdir()
        os.mkfifo(tmp_path / "decoded" / f"opencv-{identity.cv2.__version__}-contents.txt")
        assert identity.DecodedSizes()._entries == {}


def test_binary_pipeline_is_not_copied(tmp_path):
    (tmp_path / "x.yaml").write_bytes(b"# one\n# tw\xf6\nname: x\n")
    with pytest.raises(ConfigError, match=r"x\.yaml:2: expected UTF-8 text, found 0xf6"):
        clsplat.copy_pipeline(tmp_path / "x.yaml", tmp_path / "y.yaml")


@pytest.mark.parametrize("text", ["{", "[]", "{}", json.dumps({"test": 1, "gaussians": 2})])
def test_damaged_metrics_are_one_sentence_after_a_run(text, tmp_path):
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(DataError, match=r"metrics\.json: "):
        summarize_run(tmp_path)

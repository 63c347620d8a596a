"""Plug-ins: loading, recording, refusals, and the same bits as built-in code."""

import ast
import json
import re
import shutil
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, as_clsplat_error
from clsplat.core.settings import Settings, variants
from clsplat.density.edit import Rule
from clsplat.pipeline import plugins
from clsplat.pipeline.loading import load
from clsplat.scene.detect import readers
from tests.support.commands import clsplat
from tests.support.runs import train

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
RULE = """
from typing import Literal
from clsplat.density.edit import Edit
from clsplat.density.edit import Rule

class Nothing(Rule):
    type: Literal["{name}"] = "{name}"

    def mark(self, edit: Edit) -> None:
        pass
"""
TRIAL = (
    *("optimize.losses=[l1, {type: opacity_entropy, weight: 0.02}]", "optimize.steps=20", "optimize.log_every=10"),
    "optimize.views={transforms: [{type: box_blur, reach: [[0, 3], [40, 0]]}]}",
)


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("without_plugins")]


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / f"{name}.py"
    path.write_text(text)
    return path


def test_class_in_a_file_is_a_variant(tmp_path):
    plugins.load_file(write(tmp_path, "mine", RULE.format(name="mine")))
    assert "mine" in variants(Rule)
    assert load("splat", ["densify.rules=[mine]"]).resolved_settings()["plugins"].keys() == {"mine"}


def test_curve_in_a_file_is_a_schedule(tmp_path):
    text = """
import math
from clsplat.core.schedule import Curve

class Wave(Curve):
    mean: float
    period: int

    def at(self, step: int) -> float:
        return self.mean * (1 + 0.5 * math.sin(2 * math.pi * step / self.period))

    @property
    def values(self) -> list[float]:
        return [0.5 * self.mean]
"""
    plugins.load_file(write(tmp_path, "wave", text))
    rates = load("splat", ["optimize.rates.quats={mean: 0.002, period: 100}"]).settings.training.rates
    assert rates.at(25, 1.0)["quats"] == pytest.approx(0.003)
    with pytest.raises(ConfigError, match="expected values at least 0"):
        load("splat", ["optimize.rates.quats={mean: -0.002, period: 100}"])


def test_shipped_pipelines_name_no_plugin():
    assert "plugins" not in load("splat").resolved_settings()


def test_schema_includes_plugins(tmp_path):
    from clsplat.pipeline.recipes import json_schema

    plugins.load_file(write(tmp_path, "mine", RULE.format(name="mine")))
    assert "Nothing" in json_schema()["$defs"]


def test_hash_covers_kernels_and_their_headers(tmp_path):
    path = write(tmp_path, "mine", "KERNELS = 'other.cl'\n")
    (tmp_path / "other.cl").write_text('#include "own.h"\n')
    (tmp_path / "own.h").write_text("#define A 1\n")
    (tmp_path / "stranger.cl").write_text("x")
    before = plugins.hash_plugin_files(path)
    (tmp_path / "stranger.cl").write_text("y")
    assert plugins.hash_plugin_files(path) == before
    (tmp_path / "own.h").write_text("#define A 2\n")
    assert plugins.hash_plugin_files(path) != before


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import os\n1 / 0\n", r"bad\.py:2: importing the plug-in failed: ZeroDivisionError: division by zero"),
        ("x = (\n", r"bad\.py:1: importing the plug-in failed: SyntaxError: '\(' was never closed"),
        ("import not_there_at_all\n", r"bad\.py:1: .*ModuleNotFoundError: No module named 'not_there_at_all'"),
        (RULE.format(name="clone"), r"two variants of \w+ have the name 'clone'"),
    ],
)
def test_failing_plugin_is_one_line_and_registers_nothing(tmp_path, text, message):
    before = list(Settings.subclasses)
    with pytest.raises(ConfigError, match=message) as error:
        plugins.load_file(write(tmp_path, "bad", text))
    assert "\n" not in str(error.value)
    assert Settings.subclasses == before
    load("splat", ["densify.rules=[clone]"])


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        ("after: int = 3\n    def mark(self, edit): pass", r"class Mine: expected one name, as in .type: Literal"),
        ("type: str = 'mine'\n    def mark(self, edit): pass", "class Mine: expected one name"),
        ("type: Literal['mine', 'other'] = 'mine'\n    def mark(self, edit): pass", "class Mine: expected one name"),
        ("type: Literal['mine'] = 'mine'", "class Mine: lacks mark"),
    ],
)
def test_unnameable_class_is_refused(tmp_path, body, fault):
    head = "from typing import Literal\nfrom clsplat.density.edit import Rule\nclass Mine(Rule):\n    "
    with pytest.raises(ConfigError, match=fault):
        plugins.load_file(write(tmp_path, "mine", head + body + "\n"))
    assert "mine" not in variants(Rule)


def test_exception_of_a_plugin_names_its_file_and_line(tmp_path):
    text = RULE.format(name="raising").replace("pass", "1 / 0")
    path = write(tmp_path, "raising", text)
    plugins.load_file(path)
    try:
        variants(Rule)["raising"]().mark(None)
    except ZeroDivisionError as error:
        result = as_clsplat_error(error)
    line = text.splitlines().index("        1 / 0") + 1
    assert str(result) == f"{path}:{line}: ZeroDivisionError: division by zero"
    assert result.exit_code == 2


def test_plugin_output_does_not_reach_stdout(tmp_path, capsys):
    plugins.load_file(write(tmp_path, "printer", "print('hello')\n"))
    out, err = capsys.readouterr()
    assert (out, err) == ("", "hello\n")


def test_missing_file_and_duplicate_name_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        plugins.load_file(tmp_path / "nothing.py")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    plugins.load_file(write(tmp_path / "a", "mine", ""))
    assert plugins.load_file(tmp_path / "a" / "mine.py") in plugins.loaded_plugins(), "the same file twice is fine"
    with pytest.raises(ConfigError, match=r"another plug-in named 'mine' is loaded, from"):
        plugins.load_file(write(tmp_path / "b", "mine", ""))


def test_entry_points_are_loaded_and_recorded_where_used(tmp_path, monkeypatch):
    write(tmp_path, "installed_rule", RULE.format(name="installed"))
    monkeypatch.syspath_prepend(str(tmp_path))
    entry = EntryPoint("a_package", "installed_rule", plugins.GROUP)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    plugins.load_installed()
    assert "plugins" not in load("splat").resolved_settings()
    assert load("splat", ["densify.rules=[installed]"]).resolved_settings()["plugins"].keys() == {"a_package"}
    sys.modules.pop("installed_rule")


def test_rule_with_an_unknown_statistic_is_refused(tmp_path):
    reads = "    @property\n    def statistics(self) -> set[str]:\n        return {'mean2d_gradient'}\n"
    plugins.load_file(write(tmp_path, "clone_few", RULE.format(name="clone_few") + reads))
    with pytest.raises(ConfigError, match=r"densify\.rules.*'clone_few'.*'mean2d_gradient'.*screen_grad"):
        load("quickstart", ["densify.rules=[clone_few]"])


STATISTIC = """
from typing import Literal
from clsplat.density.statistics import Statistic

class Own(Statistic):
    type: Literal["own"] = "own"

    def add(self, gaussians, view, grad_mean2d, total):
        pass
"""
READER = """
from clsplat.scene import Reader

class {name}(Reader):
    name, expects = "{name}", "{name}.txt"

    def matches(self, path):
        return False

    def read(self, path, holdout):
        raise AssertionError
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install packages: their files by name, and their entry points."""
    folder = tmp_path / "installed"

    def install(files: dict[str, str], **entries: str) -> None:
        for name, text in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        actual = [EntryPoint(name, module, plugins.GROUP) for name, module in entries.items()]
        monkeypatch.setattr(plugins, "entry_points", lambda group: actual)

    monkeypatch.syspath_prepend(str(folder))
    yield install
    for name in [name for name in sys.modules if name.partition(".")[0] in ("my", "my_other")]:
        del sys.modules[name]


def test_installed_plugin_is_recorded_where_its_import_is_used(install):
    install(
        {
            "my/__init__.py": "",
            "my/register.py": "import my.rules, my.columns",
            "my/rules.py": RULE.format(name="one"),
            "my/columns.py": STATISTIC,
            "my_other.py": RULE.format(name="two"),
        },
        first="my.register",
        second="my_other",
    )
    plugins.load_installed()

    def recorded(rule: str) -> set[str]:
        return set(load("splat", [f"densify.rules=[{rule}]"]).settings.plugins)

    assert recorded("clone") == set()
    assert recorded("one") == {"first"}
    assert recorded("two") == {"second"}
    assert recorded("{type: clone, statistic: own}") == {"first"}


def test_installed_reader_is_recorded_always(install):
    install({"my.py": READER.format(name="Own")}, first="my")
    plugins.load_installed()
    assert set(load("splat").settings.plugins) == {"first"}


@pytest.mark.parametrize(("text", "reason"), [("\n1 / 0", "ZeroDivisionError"), ("\nx = (", "SyntaxError")])
def test_installed_plugin_error_names_file_and_line(install, text, reason):
    install({"my/__init__.py": "", "my/register.py": "import my.rules", "my/rules.py": text}, first="my.register")
    with pytest.raises(ConfigError, match=rf"/my/rules\.py:2: importing the plug-in failed: {reason}: "):
        plugins.load_installed()
    assert "my.register" not in sys.modules


def test_hash_of_an_installed_plugin_covers_its_package(install, tmp_path):
    install({"my/__init__.py": "", "my/register.py": "", "my/late.py": "x = 1"}, first="my.register")
    plugins.load_installed()
    (before,) = plugins.loaded_plugins()
    plugins._loaded.clear()
    install({"my/late.py": "x = 2"}, first="my.register")
    plugins.load_installed()
    assert plugins.loaded_plugins()[0].digest != before.digest


def test_hash_covers_modules_of_the_folder_that_are_imported(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(plugins, "_loaded", {})
    file = write(tmp_path, "mine", "from a_helper import x\n")
    digests = set()
    for text in ("x = 1", "x = 2000"):
        write(tmp_path, "a_helper", text)
        write(tmp_path, "not_imported", text)
        plugins.load_file(file)
        digests.add(plugins.loaded_plugins()[0].digest)
        write(tmp_path, "not_imported", f"{text}0")
        plugins.load_file(file)
        write(tmp_path, "a_helper", f"{text}0")
        with pytest.raises(ConfigError, match="have changed since it was loaded; restart Python"):
            plugins.load_file(file)
        plugins._loaded.clear()
        del sys.modules["a_helper"]
        Settings.subclasses[:] = [kind for kind in Settings.subclasses if kind.__module__ != "clsplat_plugin_mine"]
    assert len(digests) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (READER.format(name="Own") + "1 / 0", r"bad\.py:12: .*ZeroDivisionError"),
        (READER.format(name="Own") + "raise SystemExit(3)", r"bad\.py:12: .*SystemExit: 3"),
        (READER.format(name="COLMAP"), r"bad\.py: two readers have the name 'COLMAP'"),
    ],
)
def test_failing_plugin_leaves_no_reader_and_no_module(tmp_path, text, message):
    before = [type(reader) for reader in readers()]
    with pytest.raises(ConfigError, match=message):
        plugins.load_file(write(tmp_path, "bad", text))
    assert [type(reader) for reader in readers()] == before
    assert "clsplat_plugin_bad" not in sys.modules


def test_duplicate_name_is_detected_in_the_first_call(tmp_path):
    file = write(tmp_path, "bad", RULE.format(name="clone"))
    code = f"""
import clsplat
try:
    clsplat.load_plugin({str(file)!r})
except clsplat.core.errors.ConfigError as error:
    print(error)
clsplat.check("splat")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{file}: two variants of Rule have the name 'clone'")


def test_pipeline_with_a_missing_or_changed_plugin_is_refused(tmp_path):
    file = write(tmp_path, "mine", RULE.format(name="mine"))
    plugins.load_file(file)
    saved = tmp_path / "pipeline.yaml"
    saved.write_text(load("splat", ["densify.rules=[mine]"]).text())
    load(str(saved))
    plugins._loaded.clear()
    with pytest.raises(ConfigError, match=r"needs the plug-in 'mine', which is not loaded; use --plugin"):
        load(str(saved))
    Settings.subclasses[:] = [kind for kind in Settings.subclasses if not kind.__module__.startswith("clsplat_plugin_")]
    file.write_text(file.read_text() + "\n# changed\n")
    plugins.load_file(file)
    with pytest.raises(ConfigError, match=r"needs the plug-in 'mine', but .*mine\.py has changed \(sha256 \w{12}, was"):
        load(str(saved))


def replace_public_imports(text: str) -> str:
    """Replace imports from clsplat.plugin by those from the modules that define the names."""
    plugin = ast.parse((ROOT / "clsplat" / "plugin.py").read_text("utf-8"))
    places = {name.name: node.module for node in plugin.body if isinstance(node, ast.ImportFrom) for name in node.names}
    match = re.search(r"^from clsplat.plugin import (.+)\n", text, re.M)
    lines = [f"from {places[name]} import {name}\n" for name in match[1].split(", ")]
    return text.replace(match[0], "".join(lines))


def test_plugin_gives_the_bits_of_built_in_code(tiny_scene, tmp_path):
    """A copy of the package with the examples among its modules runs in a process of its own; the plug-ins here."""
    inside = tmp_path / "inside"
    shutil.copytree(EXAMPLES.parent / "clsplat", inside / "clsplat", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("cl_kernels", "pipelines", "data_tools"):
        shutil.copytree(EXAMPLES.parent / folder, inside / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name, room in {"opacity_entropy": "losses", "box_blur": "photos"}.items():
        text = (EXAMPLES / f"{name}.py").read_text("utf-8")
        (inside / "clsplat" / room / f"{name}.py").write_text(replace_public_imports(text), "utf-8")
        shutil.copy(EXAMPLES / f"{name}.cl", inside / "clsplat" / room)
        plugins.load_file(EXAMPLES / f"{name}.py")
    code = f"import sys; sys.path.insert(0, {str(inside)!r}); from clsplat.cli import main; main()"
    sets = [part for setting in TRIAL for part in ("--set", setting)]
    arguments = ["run", "smoke", "--scene", str(tiny_scene), "--out", str(tmp_path / "in"), *sets]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=inside)
    assert done.returncode == 0, done.stderr
    train(tiny_scene, tmp_path / "out", *TRIAL)
    within, beside = ((tmp_path / label / "point_cloud.ply").read_bytes() for label in ("in", "out"))
    assert within == beside
    recorded = (tmp_path / "out" / "pipeline.yaml").read_text()
    assert re.search(r"plugins: \{opacity_entropy: .*, box_blur: ", recorded)
    for name, setting in (("opacity_entropy", "optimize.losses=[l1]"), ("box_blur", "optimize.views.transforms=[]")):
        without = train(tiny_scene, tmp_path / f"without_{name}", *TRIAL, setting)
        assert (without.out / "point_cloud.ply").read_bytes() != within, f"{name} changes nothing"


def test_run_with_a_plugin_needs_the_plugin(tiny_scene, tmp_path):
    plugin, out = EXAMPLES / "opacity_entropy.py", tmp_path / "run"
    sets = ["--set", "optimize.losses=[l1, opacity_entropy]", "optimize.steps=4"]
    clsplat("--plugin", plugin, "run", "smoke", "--scene", tiny_scene, "--out", out, *sets)
    plugins._loaded.clear()
    for command in (["run", out / "pipeline.yaml", "--out", out, "--resume"], ["evaluate", out]):
        done = clsplat(*command, expect=2)
        assert "needs the plug-in 'opacity_entropy', which is not loaded; use --plugin" in done.stderr
        status = json.loads((out / "status.json").read_text())
        assert status["state"] == "done", "a refused command leaves the run as it was"


def test_comparison_lists_missing_plugins(tiny_scene, tmp_path, caplog):
    from clsplat.sweeps.compare.page import write_comparison

    plugins.load_file(EXAMPLES / "opacity_entropy.py")
    out = train(tiny_scene, tmp_path / "run", "optimize.losses=[l1, opacity_entropy]", "optimize.steps=4").out
    write_comparison([out], tmp_path / "with.html")
    plugins._loaded.clear()
    write_comparison([out], tmp_path / "without.html")
    sentence = "needs the plug-in 'opacity_entropy', which is not loaded"
    assert sentence in caplog.text
    assert sentence not in (tmp_path / "with.html").read_text()
    assert sentence.replace("'", "&#39;") in (tmp_path / "without.html").read_text()


# ---- the public module


def imported(text: str) -> set[str]:
    """The modules of clsplat that a text of Python imports."""
    nodes = list(ast.walk(ast.parse(text)))
    actual = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module == "clsplat":
            actual |= {f"clsplat.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            actual.add(node.module or "")
    return {name for name in actual if name.partition(".")[0] == "clsplat"}


def test_examples_and_docs_import_only_the_public_module():
    allowed = {"clsplat", "clsplat.plugin"}
    texts = {path.name: path.read_text("utf-8") for path in EXAMPLES.rglob("*.py")}
    for path in EXAMPLES.rglob("*.ipynb"):
        cells = json.loads(path.read_text("utf-8"))["cells"]
        texts[path.name] = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    faults = {name: actual for name, text in texts.items() if (actual := imported(text) - allowed)}
    page = (ROOT / "docs" / "extending.md").read_text("utf-8")
    assert '--8<-- "clsplat/' not in page, "the package's own files import other modules"
    dotted = set(re.findall(r"clsplat\.(\w+)\.\w+", page)) - {"plugin", "schema"}
    assert (faults, dotted) == ({}, set())


def test_public_module_exports_all_imports():
    from clsplat import plugin

    node = ast.parse(Path(plugin.__file__).read_text("utf-8"))
    names = {
        alias.asname or alias.name for part in node.body if isinstance(part, ast.ImportFrom) for alias in part.names
    }
    assert sorted(names) == plugin.__all__ == sorted(plugin.__all__)
    texts = {path: path.read_text("utf-8") for path in (ROOT / "clsplat").rglob("*.py")}
    may = [path for path, text in texts.items() if re.search(r"clsplat\.plugin\b|from clsplat import", text)]
    inside = [path for path in may if "clsplat.plugin" in imported(texts[path])]
    assert inside == [], "nothing in the package imports it"


def test_rule_and_the_stage_of_the_examples_act(tiny_scene, tmp_path):
    plugins.load_file(EXAMPLES / "random_pruning.py")
    rules = "[{type: prune_at_random, fraction: 0.9, opacity_below: 0.9}]"
    stages = f"{{densify: {{every: 10, start: 15, rules: {rules}}}}}, {{cap_size: {{every: 10, max_size: 0.001}}}}"
    plain = train(tiny_scene, tmp_path / "plain")
    run = train(tiny_scene, tmp_path / "run", f"optimize.during=[{stages}]")
    assert 0 < run.model.gaussians.count < plain.model.gaussians.count
    assert run.model.gaussians.get("log_scales").max() < np.log(0.0015 * run.scene.extent), "and some steps since"

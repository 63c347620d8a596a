"""Imports go down the layers only, and inside a folder in no circle."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "clsplat"
ROWS = (  # from the top down; a module imports only from lower rows, or from its own folder
    {"__main__"},
    {"cli"},
    {"plugin", "torch"},
    {"api"},
    {"blocks", "compress", "lod"},
    {"tuning"},
    {"cluster"},
    {"runs"},
    {"conformance"},
    {"bench"},
    {"compare", "inspect", "live", "terminal"},
    {"pipeline"},
    {"stages", "prepare"},
    {"report"},
    {"training"},
    {"video"},
    {"density", "metrics"},
    {"losses"},
    {"cameras", "fields", "viewer", "views", "filters"},
    {"render"},
    {"gaussians", "scene"},
    {"formats"},
    {"opencl", "pages"},
    {
        "cadence",
        "caches",
        "cores",
        "errors",
        "files",
        "harmonics",
        "holder",
        "lock",
        "manifest",
        "names",
        "ply_header",
        "plugins",
        "processes",
        "progress",
        "quaternions",
        "reading",
        "results",
    }
    | {"schedule", "settings", "signals", "streams", "version", ""},
)
ROW = {name: i for i, row in enumerate(ROWS) for name in row}
MODULES = sorted(PACKAGE.rglob("*.py"))


def unit(module: str) -> str:
    """The row entry of 'clsplat.stages.init' is 'stages', that of 'clsplat' is ''."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


TEXTS = {  # what turns results into lines of text
    "clsplat.workflows.blocks": {"status_table", "table"},
    "clsplat.sweeps.status": {"overview_text"},
    "clsplat.workflows.compress": {"table"},
    "clsplat.conformance.doctor": {"check_place", "write_page"},
    "clsplat.gaussians.validate": {"lines", "verdict"},
    "clsplat.prepare.inspect.findings": {"show"},
    "clsplat.workflows.lod": {"table"},
    "clsplat.pipeline.recipes": {"manual_text", "summaries_text"},
    "clsplat.runs.status": {"status_text"},
    "clsplat.runs.status": {"summary"},
    "clsplat.runs.verify": {"lines", "verdict"},
    "clsplat.pipeline.files": {"shipped"},  # for completion, which must be fast
}
BELOW_COMMANDS = {"api", "cli", "terminal", "errors", "files", "results", "signals", "streams", "version", ""}


def imports(path: Path) -> list[tuple[int, str]]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 or path.parent.name == "data_tools", f"{path}:{node.lineno}: relative import"
            found.append((node.lineno, node.module or ""))
            if node.module == "clsplat":
                found += [(node.lineno, f"clsplat.{alias.name}") for alias in node.names if alias.name in ROW]
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_down(path):
    own = path.relative_to(PACKAGE).with_suffix("").parts[0]
    if own == "__init__":  # it offers the names of all rooms, and imports them when they are first used
        return
    assert own in ROW, f"{path.name}: give '{own}' a row in this test and in the design"
    for line, module in imports(path):
        if not module.startswith("clsplat"):
            continue
        target = unit(module)
        if target == "data_tools":  # see below
            continue
        allowed = target == own or ROW[target] > ROW[own] or {own, target} <= ROWS[-1]
        assert allowed, f"{path}:{line}: {own or 'clsplat'} imports {module}, which is not below it"


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_the_opencl_layer_imports_pyopencl(path):
    if path.parent.name == "opencl":
        return
    for line, module in imports(path):
        assert not module.startswith("pyopencl"), f"{path}:{line}"


def test_one_module_alone_imports_dask():
    found = {
        f"{path.parent.name}/{path.name}"
        for path in MODULES
        for _, module in imports(path)
        if module.partition(".")[0] in ("dask", "distributed")
    }
    assert found == {"cluster/library.py"}
    needing = {f"clsplat.cluster.{name}" for name in ("library", "scheduler", "serving")}
    own = {PACKAGE / "cluster" / f"{name.rpartition('.')[2]}.py" for name in needing}
    named = {
        module for path in {*MODULES} - own for node in ast.parse(path.read_text()).body for module in _named_by(node)
    }
    assert not needing & named, "they are imported where an engine needs them, not at the start"


def _named_by(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.ImportFrom):
        return [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
    return [alias.name for alias in node.names] if isinstance(node, ast.Import) else []


def test_inside_a_folder_imports_are_acyclic():
    graph = {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): {
            module for _, module in imports(path) if module.startswith("clsplat")
        }
        for path in MODULES
        if path.name != "__init__.py"
    }
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, " -> ".join((*trail, module))
        if module in done or module not in graph:
            return
        for target in graph[module]:
            visit(target, (*trail, module))
        done.add(module)

    # the device builds programs and programs take devices: the only pair that uses each other, at run time
    graph["clsplat.opencl.device"].discard("clsplat.opencl.device")
    for module in graph:
        visit(module, ())


@pytest.mark.parametrize("path", sorted((PACKAGE / "cli").glob("*.py")), ids=lambda p: p.name)
def test_commands_call_the_api_alone_and_print(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("clsplat"):
            continue
        if path.stem == "data" and unit(node.module) in ("data_tools", "prepare", "scene"):
            continue
        names = {alias.name for alias in node.names}
        rooms = {name for name in names if name in ROW} if node.module == "clsplat" else {unit(node.module)}
        assert rooms <= BELOW_COMMANDS or names <= TEXTS.get(node.module, set()), f"{path}:{node.lineno}: {names}"


def test_data_tools_use_the_scene_layer_only():
    for path in sorted((PACKAGE.parent / "data_tools").glob("*.py")):
        allowed = {"scene", "errors", "files", "manifest", "progress", "quaternions", "reading"}
        for line, module in imports(path):
            if module.startswith("clsplat"):
                assert unit(module) in allowed, f"{path}:{line}: {module}"


def test_data_commands_alone_import_data_tools():
    found = {path for path in MODULES for _, module in imports(path) if unit(module) == "data_tools"}
    assert found == {PACKAGE / "cli" / "data.py"}

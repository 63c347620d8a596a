"""Packages: what each may import, how many there are, and no import cycles."""

import ast
import re
from collections import defaultdict

from tests.support.sources import FACES, FILES, PATHS, ROOT, imports, own_imports, room

ROOMS = (  # from the top down; a room imports only from those below it
    "data_tools", "cli", "api", "workflows", "sweeps", "runs", "conformance", "pipeline", "stages", "methods", "nerf",
    "prepare", "training", "density", "viewer", "metrics", "losses", "photos", "render", "gaussians", "scene",
    "formats", "opencl", "core",
)  # fmt: skip
TEXTS = {  # what turns results into lines of text, which the commands print
    "clsplat.conformance.doctor": {"check_html_path", "write_page"},
    "clsplat.core.text_table": {"text_table"},
    "clsplat.gaussians.validate": {"format_report", "verdict"},
    "clsplat.pipeline.files": {"shipped_pipelines"},  # for completion, which must be fast
    "clsplat.pipeline.recipes": {"manual_text", "summaries_text"},
    "clsplat.prepare.inspect.findings": {"show"},
    "clsplat.runs.status": {"format_status", "summarize_run"},
    "clsplat.runs.verify": {"format_files", "verdict"},
    "clsplat.sweeps.status": {"format_store_status"},
    "clsplat.workflows.align": {"format_table"},
    "clsplat.workflows.blocks": {"format_status_table", "format_table"},
    "clsplat.workflows.compress": {"format_table"},
    "clsplat.workflows.lod": {"format_table"},
}


def test_rooms_import_only_lower_rooms():
    faults = []
    for module, line, target in own_imports():
        if module in FACES:
            continue
        above, below = room(module), room(target)
        is_down = below in ROOMS and ROOMS.index(below) >= ROOMS.index(above)
        is_data_command = module == "clsplat.cli.data" and below == "data_tools"
        if above == "data_tools":
            is_down = below in {"data_tools", "scene", "core"}
        if not (is_down or is_data_command):
            faults.append(f"{module}:{line} imports {target}")
    assert not faults, "\n".join(sorted(faults))


def test_modules_have_no_import_cycles():
    graph = defaultdict(set)
    for module, _, target in own_imports():
        if PATHS[target].name != "__init__.py":
            graph[module].add(target)
    done: set[str] = set()
    faults: list[str] = []

    def visit(module: str, trail: tuple[str, ...]) -> None:
        if module in trail:
            faults.append(" -> ".join((*trail[trail.index(module) :], module)))
        elif module not in done:
            for target in sorted(graph[module]):
                visit(target, (*trail, module))
            done.add(module)

    for module in sorted(PATHS):
        visit(module, ())
    assert not faults, "\n".join(faults)


def test_few_modules_import_from_the_home_files_of_an_idea():
    """The home files are those that docs/inside.md names."""
    rows = re.findall(r"^\| (sky|motion|fields) \| (.+) \|$", (ROOT / "docs" / "inside.md").read_text(), re.MULTILINE)
    assert len(rows) == 3
    for idea, cell in rows:
        homes = [ROOT / name for name in re.findall("`([^`]+)`", cell)]
        assert not [home for home in homes if not home.exists()]
        own = {module for module, path in PATHS.items() if {path, path.parent} & {*homes}}
        others = {module for module, _, target in own_imports() if target in own and module not in own}
        assert len(others) <= 12, f"{idea}: {', '.join(sorted(others))}"


def test_rooms_are_few_and_have_a_reason():
    folders = {path.parent for path in FILES}
    rooms = {folder.name for folder in folders if folder.parent in (ROOT, ROOT / "clsplat")} - {"clsplat"}
    assert rooms == set(ROOMS)
    assert len(rooms) <= 24
    assert len(FILES) <= 350
    docstrings = {folder: ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) for folder in folders}
    assert not [folder.name for folder, text in docstrings.items() if not text]


def test_few_modules_import_pyopencl_dask_and_data_tools():
    users = defaultdict(set)
    for module in PATHS:
        for _, target in imports(module):
            users[target.partition(".")[0]].add(module)
            if room(module) != "data_tools" and target.startswith("clsplat.data_tools"):
                users["data_tools"].add(module)
    assert {room(module) for module in users["pyopencl"]} == {"opencl"}
    assert users["dask"] | users["distributed"] == {"clsplat.sweeps.dask"}
    assert users["data_tools"] == {"clsplat.cli.data"}


def test_dask_is_imported_only_where_an_engine_needs_it():
    faults = [
        f"{module}:{node.lineno}"
        for module in PATHS
        for node, _ in imports(module)
        if isinstance(node, ast.ImportFrom) and node.col_offset == 0
        for alias in node.names
        if "clsplat.sweeps.dask" in (node.module, f"{node.module}.{alias.name}")
    ]
    assert not faults, faults


def test_commands_call_only_the_api():
    below = {"api", "cli", "core", "data_tools", ""}
    faults = []
    for path in sorted((ROOT / "clsplat" / "cli").glob("*.py")):
        allowed = below | ({"prepare", "scene"} if path.stem == "data" else set())
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("clsplat."):
                continue
            names = {alias.name for alias in node.names}
            if room(node.module or "") not in allowed and not names <= TEXTS.get(node.module or "", set()):
                faults.append(f"{path.name}:{node.lineno}: {node.module}: {names}")
    assert not faults, faults

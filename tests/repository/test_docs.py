"""The documentation matches the code: keys, commands, links, versions, and the map of folders."""

import importlib
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import typer
from packaging.requirements import Requirement
from ruamel.yaml import YAML

import clsplat
from clsplat.cli import app
from clsplat.cli.data import app as tools
from clsplat.density.statistics import Statistic
from clsplat.formats.splats import PARAMETERS
from clsplat.losses.base import Loss
from clsplat.photos.sampling import ViewSettings
from clsplat.pipeline.loading import load
from clsplat.scene.detect import readers
from clsplat.training.adam import Rates
from clsplat.training.modules.base import TrainingModule
from clsplat.training.modules.sky import SKY

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))

from families import families, tag, undescribed_keys, unnamed_settings  # noqa: E402
from other_pages import other_pages  # noqa: E402
from python_pages import FOLDER  # noqa: E402
from reference_pages import key_table, reference_pages  # noqa: E402
from schedule_page import EXAMPLES, SAMPLES  # noqa: E402
from yaml_examples import fields_of, find_example  # noqa: E402

pytestmark = pytest.mark.slow

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
HOW_TO = (
    *(
        "photographs",
        "difficult_captures",
        "troubleshooting",
        "install",
        "runs",
        "growth",
        "compression",
        "lod",
        "blocks",
    ),
    *("formats", "align", "viewer", "video", "live", "pipelines", "training", "moving", "nerf", "python"),
    *(
        "splat_files",
        "datasets",
        "devices",
        "sweeps",
        "deploy",
        "extending",
        "plugin_examples",
        "reliability",
        "first_scene",
    ),
)
NAMED = [(base, kind) for base, kinds in families().items() for kind in kinds]


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(language: str) -> list[tuple[str, str]]:
    """Code of a language on all pages, with the page's name."""
    pattern = re.compile(rf"^ *```{language}\b[^\n]*\n(.*?)^ *```", re.M | re.S)
    return [(page.name, code) for page in PAGES for code in pattern.findall(text_of(page))]


def check_manual_and_example(pages, base, kind):
    """What a pipeline names has a part of a page, with all of its keys, and an example that is valid."""
    assert kind.__doc__ not in (None, base.__doc__)
    page = next(text for text in pages if f"{{: #{tag(kind)} }}\n\n{kind.__doc__[:20]}" in text)
    assert all(f"| `{name}` |" in page for name in kind.model_fields if name not in ("type", "stage")), page
    (value,) = YAML(typ="safe").load(find_example(base, kind)[0]).values()
    item = value[0] if isinstance(value, list) else value
    if "type" in kind.model_fields and isinstance(item, str):
        item = {"type": item}
    if "stage" not in kind.model_fields:
        assert kind.model_validate(item).model_dump(exclude_unset=True) == item
    elif item != tag(kind) and "during" not in fields_of(item):
        assert kind.model_validate({"stage": tag(kind), **fields_of(item)}).model_dump(exclude_unset=True)


def test_every_variant_has_a_manual_and_a_valid_example():
    pages, faults = list(reference_pages().values()), []
    for base, kind in NAMED:
        try:
            check_manual_and_example(pages, base, kind)
        except Exception as error:  # all of them are shown at once
            faults.append(f"{base.__name__} {tag(kind)}: {error}")
    assert not faults, "\n".join(faults)


def test_key_table_has_types_and_bounds():
    (split,) = [kind for _, kind in NAMED if tag(kind) == "split"]
    row = next(line for line in key_table(split).splitlines() if line.startswith("| `children` |"))
    assert row.startswith("| `children` | whole number ≥ 2 and ≤ 8 | `2` |")


def test_key_table_has_schedules_and_their_bounds():
    (blur,) = [kind for _, kind in NAMED if tag(kind) == "blur"]
    assert "| `sigma` | [number or schedule](schedules.md) ≥ 0 | required |" in key_table(blur)
    (rule,) = [kind for _, kind in NAMED if tag(kind) == "prune_faint"]
    assert "| `opacity_below` | [number or schedule](schedules.md) > 0 | `0.005` |" in key_table(rule)


def test_every_key_has_a_description():
    assert undescribed_keys() == []


def test_reference_lists_every_reader_and_schedule_notation():
    pages = reference_pages()
    for reader in readers():
        assert f"## {reader.name}\n" in pages["reference/readers.md"]
        assert f"It looks for {reader.expects}." in pages["reference/readers.md"]
    for title in ("A constant", "Points", "Points with keys", "Exponential decay"):
        assert pages["reference/schedules.md"].count(f"## {title}") >= 1
    assert "| [`optimize.rates`](settings.md#rates) | `means`" in pages["reference/schedules.md"]


def test_examples_of_schedules_are_valid():
    for _, sample in (*EXAMPLES.values(), *(("", text) for text in SAMPLES.values())):
        ((name, value),) = YAML(typ="safe").load(sample).items()
        (kind,) = [item for item in (Loss, Rates, ViewSettings) if name in item.model_fields]
        kind.model_validate({name: value})


def test_every_page_is_in_the_navigation():
    matches = re.findall(r": (\S+\.md)$", text_of(ROOT / "mkdocs.yml"), re.M)
    assert f"{FOLDER}/\n" in text_of(ROOT / "mkdocs.yml")
    listed = re.findall(r"\((\w+\.md)\)", other_pages()[f"{FOLDER}/SUMMARY.md"])
    matches += [f"{FOLDER}/{name}" for name in ("SUMMARY.md", *listed)]
    written = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    assert set(matches) == written | reference_pages().keys() | other_pages().keys()
    assert len(matches) == len(set(matches))


def test_how_to_pages_are_short_and_have_no_measurements():
    for name in HOW_TO:
        text = text_of(ROOT / "docs" / f"{name}.md")
        assert len(text.split()) <= 900, f"{name}: {len(text.split())} words"
        assert not re.findall(r"^\|.*\d dB.*$", text, re.M), f"{name}: measurements belong in docs/results"


def test_documented_skip_reasons_match_the_program():
    section = (
        text_of(ROOT / "docs" / "photographs.md").partition("## When photos are left out")[2].partition("\n## ")[0]
    )
    reasons = re.findall(r"^\| (.+?) \|", section, re.M)[1:]
    source = text_of(ROOT / "clsplat" / "prepare" / "diagnosis.py")
    assert len(reasons) == 7
    for reason in reasons:
        part = max(re.split(r"\bN features\b|\bN\b|b\.jpg", reason), key=len)
        assert part.strip() in source, reason


def test_navigation_has_at_most_seven_groups():
    assert len(re.findall(r"^  - (.+):$", text_of(ROOT / "mkdocs.yml").partition("\nnav:")[2], re.M)) <= 7


def test_every_included_file_exists():
    names = [name for page in PAGES for name in re.findall(r'^--8<-- "(.+)"', text_of(page), re.M)]
    assert names
    assert [name for name in names if not (ROOT / name).is_file()] == []


def test_documented_kernel_test_passes():
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "examples/test_opacity_entropy.py"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout


def test_paths_and_bases_on_pages_exist():
    for page in PAGES:
        for path in re.findall(r"`((?:clsplat|tests|docs|examples|pipelines|cl_kernels)/[\w./]*\w/?)`", text_of(page)):
            assert (ROOT / path).exists(), f"{page.name}: {path}"
    bases = re.findall(r"^\| a[^|]*\| `clsplat\.([\w.]+)\.(\w+)`", text_of(ROOT / "docs" / "extending.md"), re.M)
    assert len(bases) >= 9
    for module, name in bases:
        assert hasattr(importlib.import_module(f"clsplat.{module}"), name), f"clsplat.{module}.{name}"


def test_documented_package_names_exist():
    code = [code for _, code in blocks("python")]
    tables = [line for page in PAGES for line in re.findall(r"^\|.*$", text_of(page), re.M)]
    names = {name for text in (*code, *tables) for name in re.findall(r"\bclsplat\.([A-Za-z_]\w*)\(", text)}
    assert {"read_scene", "Trainer", "Renderer", "run", "load_plugin"} <= names
    assert [name for name in names if not hasattr(clsplat, name)] == []


def test_whole_pipelines_on_pages_are_valid(tmp_path):
    whole = [(page, code) for page, code in blocks("yaml") if re.search(r"^stages:", code, re.M)]
    assert whole
    for page, code in whole:
        file = tmp_path / f"{page}.yaml"
        file.write_text(code if "name:" in code else f"name: shown\n{code}")
        load(str(file))


def test_commands_on_pages_exist():
    group, data = typer.main.get_command(app), typer.main.get_command(tools)
    names = {name: options(group.get_command(None, name)) for name in group.list_commands(None)}
    parts = {name: options(command) for name, command in data.commands.items()}
    shown = [
        (page, line) for page, code in blocks("sh") for line in re.findall(r"^(?:\w+=\S+ )?clsplat (.*)$", code, re.M)
    ]
    assert len(shown) > 30
    for page, line in shown:
        words = re.sub(r"'[^']*'", "", line.partition("#")[0]).split()
        command = next((word for word in words if word in names), None)
        assert command, f"{page}: clsplat {line}"
        known = names[command] | options(group)
        if command == "data":
            part = words[words.index("data") + 1]
            assert part in parts, f"{page}: clsplat {line}"
            known |= parts[part]
        assert {word for word in words if word.startswith("--")} <= known, f"{page}: clsplat {line}"


def options(command) -> set[str]:
    return {option for parameter in command.params for option in parameter.opts}


def test_links_between_repository_files_are_valid():
    generated = reference_pages() | other_pages()
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text_of(page)):
            path = (page.parent / target).resolve()
            made = path.is_relative_to(ROOT / "docs") and path.relative_to(ROOT / "docs").as_posix() in generated
            assert made or path.exists(), f"{page.name}: {target}"


def test_front_page_is_short():
    assert len(text_of(ROOT / "README.md").splitlines()) < 130


def test_folder_map_matches_the_disk():
    shown = text_of(ROOT / "docs" / "inside.md").partition("```text")[2].partition("```")[0]
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    files = [Path(name) for name in listed if not name.startswith(".")]
    folders = {path.parts[0] for path in files if len(path.parts) > 1}
    rooms = {path.parts[1] for path in files if path.parts[0] == "clsplat" and len(path.parts) > 2}
    assert set(re.findall(r"^(\w+)/", shown, re.M)) == folders
    assert set(re.findall(r"^  (\w+)/", shown, re.M)) == rooms
    modules = {
        path.stem for path in files if path.parts[0] == "clsplat" and len(path.parts) == 2 and path.suffix == ".py"
    }
    missing = [name for name in modules if not name.startswith("_") and not re.search(rf"\b{name}\b", shown)]
    assert missing == [], "modules that are not on the map"


def test_glossary_is_sorted():
    words = re.findall(r"^\*\*(.+?)\*\* —", text_of(ROOT / "docs" / "glossary.md"), re.M)
    assert len(words) >= 20
    assert words == sorted(words)


def test_names_in_the_glossary_exist(few_steps):
    """Keys, classes, tables, and checkpoint entries of the table "One concept, one name"."""
    classes = [*unnamed_settings(), *(kind for base, kinds in families().items() for kind in (base, *kinds))]
    keys = {name for kind in classes for name in (tag(kind), *kind.model_fields)}
    by_name = {kind.__name__: kind for kind in [*classes, clsplat.Model, clsplat.Scene, clsplat.View]}
    tables = {*PARAMETERS, "filter_variance", *(tag(kind) for kind in families()[Statistic])}
    checkpoint = zipfile.ZipFile(few_steps / "checkpoints" / "step_000012.npz").namelist()
    saved = {name.removesuffix(".npy") for name in checkpoint} | {f"stats/{name}" for name in tables}
    saved |= {f"modules/{name}" for name in (*(tag(kind) for kind in families()[TrainingModule]), SKY)}
    rows = re.findall(r"^\| [^|]+\|(.*)\|(.*)\|(.*)\|(.*)\|[^|]*\|$", text_of(ROOT / "docs" / "glossary.md"), re.M)
    assert len(rows) > 10
    for row in rows:
        yaml, python, table, entry = (re.findall(r"`(.+?)`", cell) for cell in row)
        assert {part for name in yaml for part in re.split(r"[.:] ?", name)} <= keys, row
        for kind, _, field in (name.partition(".") for name in python):
            assert not field or hasattr(by_name[kind], field) or field in by_name[kind].__annotations__, row
        assert set(table) <= tables, row
        assert set(entry) <= saved, row


def test_versions_agree_in_all_files():
    project = tomllib.loads(text_of(ROOT / "pyproject.toml"))["project"]
    citation = YAML(typ="safe").load(text_of(ROOT / "CITATION.cff"))
    assert project["version"] == clsplat.__version__ == str(citation["version"])
    first = re.search(r"^## \[(.+?)\](?: - (.+))?$", text_of(ROOT / "CHANGELOG.md"), re.M)
    released = "Unreleased" if ".dev" in clsplat.__version__ else clsplat.__version__
    assert (first[1], first[2]) == (released, citation.get("date-released"))


def test_changelog_is_short():
    assert len(text_of(ROOT / "CHANGELOG.md").splitlines()) <= 200


def test_issue_forms_are_complete():
    forms = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    assert len(forms) >= 3
    for form in forms:
        data = YAML(typ="safe").load(text_of(form))
        if form.stem != "config":
            assert {"name", "description", "body"} <= set(data), form.name
            assert all(part["attributes"]["label"] for part in data["body"]), form.name


@pytest.mark.parametrize(
    ("system", "machine", "python", "wheels"),
    [
        ("linux", "x86_64", "3.11", True),
        ("linux", "x86_64", "3.15", False),
        ("linux", "aarch64", "3.13", False),
        ("darwin", "arm64", "3.13", True),
        ("darwin", "x86_64", "3.13", False),
        ("win32", "AMD64", "3.14", True),
    ],
)
def test_pycolmap_is_required_where_it_has_wheels(system, machine, python, wheels):
    project = tomllib.loads(text_of(ROOT / "pyproject.toml"))["project"]
    (needed,) = [item for item in map(Requirement, project["dependencies"]) if item.name == "pycolmap"]
    place = {"sys_platform": system, "platform_machine": machine, "python_version": python}
    assert needed.marker
    assert needed.marker.evaluate({**place, "platform_python_implementation": "CPython"}) == wheels
    assert "photos" not in project["optional-dependencies"], "nothing is left for it"

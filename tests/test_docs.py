"""What the documentation says holds: keys, commands, links, versions, the map of folders."""

import re
import sys
import tomllib
from pathlib import Path

import pytest
import typer
from packaging.requirements import Requirement
from ruamel.yaml import YAML

import clsplat
from clsplat import pipeline
from clsplat.cli import app

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs"))

from families import families, tag, undescribed  # noqa: E402
from reference_pages import key_table, reference_pages  # noqa: E402
from yaml_examples import example, fields_of  # noqa: E402

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMED = [(base, kind) for base, kinds in families().items() for kind in kinds]
AWAITED_OPTIONS = {"--plugin"}


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(language: str) -> list[tuple[str, str]]:
    """Code of a language on all pages, with the page's name."""
    found = re.compile(rf"^ *```{language}\b[^\n]*\n(.*?)^ *```", re.M | re.S)
    return [(page.name, code) for page in PAGES for code in found.findall(text_of(page))]


@pytest.mark.parametrize(("base", "kind"), NAMED, ids=[f"{base.__name__}-{tag(kind)}" for base, kind in NAMED])
def test_what_a_pipeline_can_name_has_a_manual_and_a_valid_example(base, kind):
    assert kind.__doc__ not in (None, base.__doc__)
    page = next(text for text in reference_pages().values() if f"{{: #{tag(kind)} }}\n\n{kind.__doc__[:20]}" in text)
    assert all(f"| `{name}` |" in page for name in kind.model_fields if name not in ("type", "stage")), page
    (value,) = YAML(typ="safe").load(example(base, kind)[0]).values()
    item = value[0] if isinstance(value, list) else value
    if "stage" not in kind.model_fields:
        assert kind.model_validate(item).model_dump(exclude_unset=True) == item
    elif item != tag(kind) and "during" not in fields_of(item):
        assert kind.model_validate({"stage": tag(kind), **fields_of(item)}).model_dump(exclude_unset=True)


def test_a_table_of_keys_says_what_each_takes():
    (split,) = [kind for _, kind in NAMED if tag(kind) == "split"]
    row = next(line for line in key_table(split).splitlines() if line.startswith("| `children` |"))
    assert row.startswith("| `children` | whole number ≥ 2 and ≤ 8 | `2` |")


def test_every_key_has_a_description():
    assert undescribed() == []


@pytest.mark.xfail(strict=True, reason="the examples are not all there yet")
def test_every_included_file_exists():
    names = [name for page in PAGES for name in re.findall(r'^--8<-- "(.+)"', text_of(page), re.M)]
    assert names
    assert [name for name in names if not (ROOT / name).is_file()] == []


def test_whole_pipelines_on_pages_are_valid(tmp_path):
    whole = [(page, code) for page, code in blocks("yaml") if re.search(r"^stages:", code, re.M)]
    assert len(whole) >= 2
    for page, code in whole:
        file = tmp_path / f"{page}.yaml"
        file.write_text(code if "name:" in code else f"name: shown\n{code}")
        pipeline.load(str(file))


def test_commands_on_pages_exist():
    group = typer.main.get_command(app)
    names = {name: {option for p in c.params for option in p.opts} for name, c in group.commands.items()}
    names["data"] |= {"--folder"}
    unknown = set()
    for page, code in blocks("sh"):
        for line in re.findall(r"^(?:\w+=\S+ )?clsplat (.*)$", code, re.M):
            words = line.partition("#")[0].split()
            command = next((word for word in words if word in names), None)
            assert command, f"{page}: clsplat {line}"
            unknown |= {word for word in words if word.startswith("--")} - names[command]
    assert unknown == AWAITED_OPTIONS


def test_links_between_files_of_the_repository_hold():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text_of(page)):
            made = (ROOT / "docs" / target).relative_to(ROOT / "docs").as_posix() in reference_pages()
            made |= target in ("reference/commands.md", "reference/pipelines.md", "reference/python.md")
            assert made or (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_front_page_is_short():
    assert len(text_of(ROOT / "README.md").splitlines()) < 130


def test_the_map_shows_every_room():
    shown = text_of(ROOT / "docs" / "inside.md").partition("```text")[2].partition("```")[0]
    for path in sorted((ROOT / "clsplat").iterdir()):
        if path.is_dir() and path.name != "__pycache__":
            assert f"  {path.name}/ " in shown, f"{path.name}/ is not on the map"
        elif path.suffix == ".py" and not path.stem.startswith("_"):
            assert re.search(rf"\b{path.stem}\b", shown), f"{path.name} is not on the map"


def test_the_glossary_is_in_order():
    words = re.findall(r"^\*\*(.+?)\*\* —", text_of(ROOT / "docs" / "glossary.md"), re.M)
    assert len(words) >= 20
    assert words == sorted(words)


def test_all_files_name_the_same_version():
    project = tomllib.loads(text_of(ROOT / "pyproject.toml"))["project"]
    citation = YAML(typ="safe").load(text_of(ROOT / "CITATION.cff"))
    assert project["version"] == clsplat.__version__ == str(citation["version"])
    date = citation["date-released"]
    assert f"## [{clsplat.__version__}] - {date}" in text_of(ROOT / "CHANGELOG.md")


def test_forms_are_complete():
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
def test_pycolmap_comes_along_where_it_has_wheels(system, machine, python, wheels):
    project = tomllib.loads(text_of(ROOT / "pyproject.toml"))["project"]
    (needed,) = [one for one in map(Requirement, project["dependencies"]) if one.name == "pycolmap"]
    place = {"sys_platform": system, "platform_machine": machine, "python_version": python}
    assert needed.marker
    assert needed.marker.evaluate({**place, "platform_python_implementation": "CPython"}) == wheels
    assert project["optional-dependencies"]["photos"] == []

"""Pages: escaped values, no external resources, and equal bytes for equal input."""

import ast
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from jinja2 import UndefinedError

import clsplat as package
from clsplat.core.page import TEMPLATES, data_url, duration_text, mark_charts_safe, render, require_complete
from clsplat.viewer.charts import Line, line_chart
from tests.support.commands import clsplat
from tests.support.html_page import HOSTILE, Page
from tests.support.refusals import refusal

SOURCES = sorted(Path(package.__file__).parent.rglob("*.py"))
PAGES = ("report", "compare", "compress", "inspect", "notebook", "doctor", "store", "viewer", "live")
FOLDER = Path(package.__file__).parent / "core" / "templates"
DRAWINGS = {"clsplat/viewer/charts.py"}  # SVG, escaped there
STATES = ("good", "warn", "bad", "note")  # colors of text with papers of their own
WITHOUT_TEXT = {  # a background, or text on one that another rule or the page's data fix
    *("td.bar i", "button.grown", ".slider::after", ".chip"),
}
TAG = re.compile(r"</?(html|head|body|p|div|span|table|t[rdh]|h\d|ul|li|a|b|i|br|img|pre|figure|svg|style|script)[\s>]")


def strings(path: Path) -> list[tuple[int, str]]:
    """The string literals of a source file, and the parts of its f-strings, with their lines."""
    text = path.read_text()
    nodes = ast.walk(ast.parse(text)) if "<" in text else ()  # no tag begins otherwise
    constants = [node for node in nodes if isinstance(node, ast.Constant)]
    return [(node.lineno, node.value) for node in constants if isinstance(node.value, str)]


def test_html_is_only_in_templates():
    faults, drawing = [], set()
    for path in SOURCES:
        name, texts = path.relative_to(Path(package.__file__).parents[1]).as_posix(), strings(path)
        tags = [f"{name}:{line}: HTML belongs into a template" for line, text in texts if TAG.search(text)]
        if name in DRAWINGS and tags:
            drawing.add(name)
        elif name not in DRAWINGS:
            faults += tags
            faults += [f"{name}: templates escape what they show"] if "html.escape" in path.read_text() else []
    assert not faults, "\n".join(faults)
    assert drawing == DRAWINGS, "what draws no more is taken from the list"


def luminance(color: str) -> float:
    """Of #rgb or #rrggbb, as WCAG has it."""
    digits = color[1:] if len(color) == 7 else "".join(2 * digit for digit in color[1:])
    parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_text_has_enough_contrast(mode):
    light, dark = re.findall(r":root \{(.*?)\}", (FOLDER / "base.css").read_text(), re.DOTALL)
    actual = [dict(re.findall(r"--([\w-]+): (#\w+)", text)) for text in (light, dark)]
    assert actual[0].keys() == actual[1].keys(), "a color of one mode alone"
    colors = actual[mode == "dark"]
    on_paper = [(text, "paper") for text in ("ink", "soft", "link", "good", "warn", "bad")]
    for text, paper in [
        *on_paper,
        ("ink", "card"),
        *((name, f"{name}-paper") for name in STATES),
        ("ink", "note-paper"),
    ]:
        dark, light = sorted((luminance(colors[text]), luminance(colors[paper])))
        assert (light + 0.05) / (dark + 0.05) >= 4.5, f"{text} on {paper}"


def test_colors_follow_dark_mode():
    """Where one of both is fixed, so is the other: the page's own is dark or light."""
    faults = []
    for path in (path for path in FOLDER.iterdir() if path.suffix in (".css", ".j2")):
        text = path.read_text()
        blocks = re.findall(r"block style %\}(.*?)\{% endblock", text, re.DOTALL)
        for names, rule in re.findall(r"([^{}]+)\{([^{}]*)\}", text if path.suffix == ".css" else "".join(blocks)):
            fixed = {key for key in ("color", "background") if re.search(rf"(?<![-\w]){key}:[^;]*#\w", rule)}
            if len(fixed) == 1 and names.strip() not in WITHOUT_TEXT:
                faults.append(f"{path.name}: {names.strip()}: one fixed color")
    assert not faults, "\n".join(faults)


def test_only_one_module_marks_text_as_safe():
    actual = [path.name for path in SOURCES for line in path.read_text().splitlines() if "Markup(" in line]
    assert actual == ["page.py"]
    for path in FOLDER.iterdir():
        assert not re.search(r"\|\s*safe|autoescape|Markup", path.read_text()), f"{path.name} puts in text unescaped"


def test_every_template_file_is_part_of_a_page():
    pages = [path.read_text() for path in FOLDER.glob("*.j2")]
    for path in FOLDER.iterdir():
        page = path.name.removesuffix(".html.j2") in PAGES
        assert page or any(f'"{path.name}"' in text for text in pages), path.name


def test_values_are_escaped_and_charts_are_not():
    values = {"state": "ready", "verdict": HOSTILE, "findings": [], "facts": {HOSTILE: HOSTILE}, "cameras": []}
    chart = line_chart(HOSTILE, [Line([(0.0, 0.0), (1.0, 1.0)])])
    seen = mark_charts_safe([chart, ""]), [(HOSTILE, 3)]
    page = Page(
        render("inspect.html.j2", title=HOSTILE, subtitle=HOSTILE, points_per_view=seen, far="", lists=[], **values)
    )
    assert page.elements["script"] == 0
    assert page.elements["svg"] == 1
    assert page.text.count(HOSTILE) == 8, "title twice, subtitle, verdict, a figure twice, a view, a chart"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("try `a --b`, or `c` twice", "try <code>a --b</code>, or <code>c</code> twice"),
        ("`a` ends", "<code>a</code> ends"),
        ("it is `a`", "it is <code>a</code>"),
        ("a`b is <i>", "a`b is &lt;i&gt;"),
        ("`a` and b`c", "<code>a</code> and b`c"),
        ("`<script>`", "<code>&lt;script&gt;</code>"),
    ],
)
def test_text_in_backticks_is_code(text, found):
    page = TEMPLATES.from_string("{% from 'macros.html.j2' import words %}{{ words(text) }}")
    assert page.render(text=text).strip() == found


def test_missing_template_value_is_an_error():
    with pytest.raises(UndefinedError, match="is undefined"):
        render("inspect.html.j2", title="a", subtitle="b")


def test_data_cannot_close_its_script():
    text = TEMPLATES.from_string("{{ data | tojson }}").render(data={"b": "</script>", "a": [1]})
    assert text == '{"b":"\\u003c/script\\u003e","a":[1]}'
    assert json.loads(text)["b"] == "</script>"


def test_name_that_is_not_unicode_shows_a_question_mark():
    page = render("inspect.html.j2", title="\udcff.png", subtitle="", state="ready", verdict="", findings=[],
                  facts={}, cameras=[], far="", points_per_view=None, lists=[])  # fmt: skip
    assert "<title>?.png</title>" in page


@pytest.mark.parametrize(("seconds", "words"), [
    (0.4, "0 s"), (59.4, "59 s"), (60, "1 min 0 s"), (3599, "59 min 59 s"), (3600, "1 h 0 min"), (7322, "2 h 2 min"),
])  # fmt: skip
def test_durations_are_written_in_words(seconds, words):
    assert duration_text(seconds) == words


def test_embedded_images_name_their_format():
    image = np.zeros((2, 3, 3), np.uint8)
    assert data_url(image).startswith("data:image/jpeg;base64,/9j/")
    assert data_url(image, ".png").startswith("data:image/png;base64,iVBOR")


def hostile_scene(tiny_scene: Path, folder: Path) -> Path:
    """The tiny scene with a name of markup, and another for each test photograph."""
    scene = shutil.copytree(tiny_scene, folder / HOSTILE)
    table = json.loads((scene / "transforms_test.json").read_text())
    for i, frame in enumerate(table["frames"]):
        file = next(scene.glob(frame["file_path"].removeprefix("./") + "*"))
        frame["file_path"] = f"./test/{HOSTILE}{i}"
        file.rename(scene / "test" / f"{HOSTILE}{i}{file.suffix}")
    (scene / "transforms_test.json").write_text(json.dumps(table))
    return scene


def test_report_escapes_markup_in_names(tiny_scene, tmp_path):
    scene, out = hostile_scene(tiny_scene, tmp_path), tmp_path / "run"
    clsplat("run", "smoke", "--scene", scene, "--out", out, "--set", "optimize.steps=30", "optimize.log_every=10")
    page = Page((out / "report.html").read_text())
    assert (page.elements["script"], page.elements["b"]) == (1, 6), "the page's own, and labels of six images"
    first = page.text.partition("Walk through")[0]
    assert re.search(r"test PSNR \d+\.\d\d dB, SSIM 0\.\d{4} · \d+,\d{3} Gaussians · trained for \d+ s", first)
    assert page.text.count(HOSTILE) >= 2, "its title, twice"
    assert all(f"test/{HOSTILE}{i} (test): " in page.text for i in (0, 1))
    settings = page.text.partition("Settings")[2]
    assert "stages:" in settings
    assert "<script>" in settings, "the scene's path"


@pytest.mark.parametrize("text", ["", "<html>", "<html></html", "<html></html><p>"])
def test_truncated_page_is_refused(text, tmp_path):
    (tmp_path / "a.html").write_text(text)
    assert (
        refusal(require_complete, tmp_path / "a.html") == f"{tmp_path / 'a.html'}: is truncated; create the page again"
    )
    (tmp_path / "a.html").write_text("<html></html>\n")
    require_complete(tmp_path / "a.html")

"""The page as text: escaping, content policy, size, photographs, and motion."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import OutputError
from clsplat.core.page import downscale, inline
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer import page as module
from clsplat.viewer.packing import pack
from clsplat.viewer.page import FOLDER, SCRIPTS, Page, camera_data, omitted_indices, read_script, view_entries
from tests.support.html_page import HOSTILE
from tests.support.html_page import Page as Parsed
from tests.support.viewer_pages import cloud, scene, views


def flat(view):
    """A photograph of one color."""
    return np.full((view.camera.height, view.camera.width, 3), 90, np.uint8)


@pytest.fixture
def page(tmp_path) -> Page:
    result, model = scene(tmp_path), cloud(60)
    stand = Viewpoint.from_points(model.means, result.views, result.views[0])
    return Page("demo", {"model": pack(model)}, stand, "white", view_entries(result, flat, "test"))


def test_same_input_gives_the_same_page(page, tmp_path):
    page.write(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text() == page.text()


def test_names_are_escaped(page):
    views = [{**view, "name": f"{HOSTILE}{i}"} for i, view in enumerate(page.views)]
    start = replace(page.viewpoint.start, name=f"{HOSTILE}0")
    models = {HOSTILE: page.models["model"], f"{HOSTILE}B": page.models["model"]}
    text = replace(
        page, title=HOSTILE, models=models, views=views, viewpoint=replace(page.viewpoint, start=start)
    ).text()
    parsed = Parsed(text)
    assert parsed.elements["script"] == 4, "the scene, two models and the program"
    assert parsed.text.count(HOSTILE) == 2 + 2 + 2 * 3, "title twice, a label and three facts of each model"
    info = json.loads(re.search(r'id="scene">(.*?)</script>', text).group(1))
    assert [view["name"] for view in info["views"]] == [f"{HOSTILE}{i}" for i in range(4)]
    assert info["first"] == 0
    assert re.fullmatch(r"[\w.-]+", info["file"])


def test_splats_too_faint_to_draw_are_reported(page):
    model = cloud(60)
    model.logit_opacity[:] = 0
    model.logit_opacity[:7] = -6
    faint = replace(page, models={"model": pack(model)})
    assert "<dd>53 Gaussians + 7 too faint to draw, SH degree" in faint.text()
    model.logit_opacity[:] = 0
    assert "too faint to draw, SH" not in replace(page, models={"model": pack(model)}).text()


def test_help_lists_touch_gestures(page):
    assert "double-click it · double-tap it" in page.text()


def test_content_policy_allows_only_package_scripts_and_styles(page):
    text = page.text()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text).group(1)
    for element in ("script", "style"):
        (content,) = re.findall(rf"<{element}>(.*?)</{element}>", text, re.S)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{element}-src 'sha256-{digest}'" in policy.replace("&#39;", "'")
    assert policy.startswith("default-src 'none'; img-src data:;")
    assert "unsafe" not in policy
    assert "http" not in text.replace("http-equiv", ""), "an address of another place"


def test_script_that_closes_its_element_is_refused():
    with pytest.raises(ValueError, match="closes its element"):
        inline("'</script>'")


def test_scripts_are_short_and_part_of_the_page():
    faults = []
    for path in sorted([*FOLDER.glob("*.js"), *FOLDER.glob("*.css")]):
        lines = path.read_text().splitlines()
        if len(lines) > 250 or max(map(len, lines)) > 120:
            faults.append(f"{path.name}: {len(lines)} lines of up to {max(map(len, lines))} columns")
        if path.stem not in (*SCRIPTS, "viewer") or (path.suffix != ".css" and path.read_text() not in read_script()):
            faults.append(f"{path.name}: is no part of the page")
    assert not faults, "\n".join(faults)


def test_too_large_page_for_browsers_is_refused(page, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_SIZE", 0.95 * page.size)
    with pytest.raises(
        OutputError, match=r"page would be 0 MB, .*show only the \d+ most important splats \(--splats \d+\)"
    ):
        page.write(tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


def test_too_large_page_blames_its_photographs(page, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_SIZE", 0.2)
    large = replace(page, views=[{"name": "a", "thumbnail": "", "photograph": "x" * 300_000}])
    with pytest.raises(OutputError, match="at most 0 MB; show fewer photos") as raised:
        large.write(tmp_path / "page.html")
    assert "splats" not in str(raised.value)


def test_suggested_splat_limit_fits(page, monkeypatch):
    model = cloud(4000)
    large = replace(page, models={"model": pack(model)})
    monkeypatch.setattr(module, "MAX_SIZE", 0.7 * large.size)
    assert 500 < large.max_splats < 3000
    fitting = replace(large, models={"model": pack(model, large.max_splats)})
    assert 0.5 * module.MAX_SIZE < fitting.size <= module.MAX_SIZE


def test_small_model_next_to_a_large_one_keeps_its_splats(page, monkeypatch):
    large = replace(page, models={"a": pack(cloud(4000)), "b": pack(cloud(40))})
    monkeypatch.setattr(module, "MAX_SIZE", 0.7 * large.size)
    assert 500 < large.max_splats < 3000


def test_page_size_matches_the_file(page, tmp_path):
    large = replace(page, models={"model": pack(cloud(20000))})
    large.write(tmp_path / "page.html")
    assert large.size == pytest.approx((tmp_path / "page.html").stat().st_size / 1e6, rel=0.05)


@pytest.mark.parametrize(
    ("sizes", "budget", "kept"),
    [
        ([5, 5, 5, 5], 20, [0, 1, 2, 3]),
        ([5, 5, 5, 5], 19, [0, 2]),
        ([5, 5, 5, 5, 5, 5, 5], 15, [0, 3, 6]),
        ([5, 5, 5, 5], 5, [0]),
        ([5, 5, 5, 5], 4, []),
        ([], 4, []),
    ],
)
def test_photographs_stay_within_a_budget(sizes, budget, kept):
    assert omitted_indices(sizes, budget) == set(range(len(sizes))) - set(kept)


@pytest.mark.parametrize(("which", "held"), [("none", []), ("test", [0, 3]), ("all", [0, 1, 2, 3])])
def test_photographs_of_the_selected_views(tmp_path, which, held):
    result = view_entries(scene(tmp_path), flat, which)
    assert [i for i, view in enumerate(result) if view["photograph"]] == held
    assert all(view["thumbnail"].startswith("data:image/jpeg;base64,") for view in result)
    assert [view["split"] for view in result] == ["test", "train", "train", "test"]
    assert all(not view["photograph"] for view in view_entries(scene(tmp_path), flat, which, budget=1e-6))


@pytest.mark.parametrize(("shape", "after"), [((300, 200), (128, 85)), ((100, 128), (100, 128)), ((2, 4000), (1, 128))])
def test_thumbnails_keep_their_aspect(shape, after):
    assert downscale(np.zeros((*shape, 3), np.uint8), 128).shape[:2] == after


def test_initial_camera_of_a_page(tmp_path):
    model, result = cloud(200), views()
    stand = Viewpoint.from_points(model.means, result, result[2])
    assert stand.start is result[2]
    assert stand.focal == 85.0
    assert stand.up @ [0, -1, 0] > 0.8
    alone = Viewpoint.from_points(model.means, (), None)
    forward = alone.start.world_to_camera[2, :3]
    toward = alone.pivot - alone.start.position
    np.testing.assert_allclose(forward, toward / np.linalg.norm(toward), atol=1e-9)
    assert Viewpoint.from_points(model.means[:0], (), None).radius > 0
    model.means[::3] = np.nan
    assert np.isfinite(Viewpoint.from_points(model.means, (), None).start.world_to_camera).all()


def test_slim_model_without_a_scene_fits_into_the_image():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.normal(0, 0.05, 2000), rng.uniform(-1, 1, 2000), rng.normal(0, 0.05, 2000)])
    start = Viewpoint.from_points(points, (), None).start
    x, y, z = start.world_to_camera @ np.vstack([points.T, np.ones(2000)])
    c = start.camera
    assert ((c.fx * np.abs(x) / z < c.cx) & (c.fy * np.abs(y) / z < c.cy)).mean() > 0.998
    background = np.concatenate([points, 100 * rng.normal(size=(50, 3))])
    other = Viewpoint.from_points(background, (), None).start
    assert np.linalg.norm(other.position) < 1.1 * np.linalg.norm(start.position), "a background is not framed"


def test_camera_keeps_its_digits():
    view = views()[1]
    data = camera_data(view)
    np.testing.assert_allclose(np.reshape(data["pose"], (3, 4)), view.world_to_camera, rtol=1e-8, atol=1e-12)
    assert data["lens"] == [80.0, 104.0, pytest.approx(33.6), pytest.approx(56.0), 112, 80]


def test_every_script_in_the_folder_is_used():
    assert sorted(path.stem for path in Path(FOLDER).glob("*.js")) == sorted(SCRIPTS)

"""Pages of moving models: their contents, and their rendering at a given time."""

from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest

import clsplat
from clsplat.formats.splats import MOTION, motion_fields, motion_width
from clsplat.gaussians.motion import evaluate_at
from clsplat.metrics.images import psnr, to_8_bits
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer.packing import pack
from clsplat.viewer.page import Page, view_entries
from tests.support.browser import CHROMIUM, Browser
from tests.support.viewer_data import unpacked
from tests.support.viewer_pages import cloud, moving, scene

WIDTHS = [motion_width(1, False), motion_width(3, False), motion_width(2, True)]
MOMENTS = (0.0, 0.35, 0.6, 1.0)
PIXELS = """(picture => {
  let letters = "";
  for (const byte of picture.data) letters += String.fromCharCode(byte);
  return [picture.width, picture.height, btoa(letters)];
})(viewer.capture())"""

NEAREST = """(() => {
  viewer.pivot = null;
  for (let x = 5; x < 160; x += 5) for (let y = 5; y < 200 && !viewer.pivot; y += 5) viewer.focus(x, y);
  return viewer.pivot;
})()"""


def page_of(folder, model) -> Page:
    """A page whose photographs are renders at four moments."""
    result = scene(folder)
    result = replace(result, views=tuple(replace(v, time=t) for v, t in zip(result.views, MOMENTS, strict=True)))
    stand = Viewpoint.from_points(model.means, result.views, result.views[0])
    renderer = clsplat.Renderer(model)
    views = view_entries(result, lambda view: to_8_bits(renderer.render(view).image), "none")
    return Page("demo", {"demo": pack(model)}, stand, "white", views)


@pytest.mark.parametrize("width", WIDTHS)
def test_motion_is_packed_after_other_planes(width):
    model = moving(cloud(300), width)
    packed = pack(model)
    pixels, fields = unpacked(packed), motion_fields(width)
    order = [int(np.linalg.norm(model.means - mean, axis=1).argmin()) for mean in pixels.means]
    known = model.motion[order].astype(np.float64)
    straight = slice(0, fields["turn"].start if "turn" in fields else width)
    np.testing.assert_allclose(pixels.motion[:, straight], known[:, straight], rtol=1e-3, atol=1e-4)
    tables = {name: values[order] for name, values in model.tables().items()}
    later = evaluate_at({**tables, MOTION: np.where(np.arange(width) == 4, 12.0, known).astype(np.float32)}, 0.7)
    if "turn" in fields:
        dt = 0.7 - pixels.motion[:, 3:4]
        turned = pixels.quats + np.roll(pixels.motion[:, fields["turn"]], 1, axis=1) * dt
        same = np.abs((turned * later["quats"]).sum(axis=1))
        same /= np.linalg.norm(turned, axis=1) * np.linalg.norm(later["quats"], axis=1)
        assert same.min() > 0.999
    assert packed.header["motion"] == {
        "columns": width,
        "bends": (width - 2 - 4 * ("turn" in fields)) // 3 - 1,
        "turns": fields["turn"].start if "turn" in fields else 0,
    }


def test_static_model_has_no_motion_and_no_slider(tmp_path):
    model = cloud(60)
    assert "motion" not in pack(model).header
    still, runs = page_of(tmp_path, model).text(), page_of(tmp_path, moving(model)).text()
    assert ['id="timestamp"' in text for text in (still, runs)] == [False, True]
    assert '"timestamps":[0.0,0.35,0.6,1.0]' in runs.replace(", ", ",").replace(": ", ":")


@pytest.mark.slow
@pytest.mark.large
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium: apt-get install chromium")
def test_browser_draws_each_photograph_at_its_time(tmp_path):
    model = moving(cloud(500), 15)
    page_of(tmp_path, model).write(tmp_path / "page.html")
    renderer = clsplat.Renderer(model)
    with Browser(tmp_path / "profile", 160, 200) as browser:
        browser.open(tmp_path / "page.html")
        for i, (view, moment) in enumerate(zip(scene(tmp_path).views[:2], MOMENTS, strict=False)):
            browser.run(f"viewer.photographs.choose({i}, 0)")
            browser.rest()
            assert browser.run("viewer.timestamp") == moment
            width, height, text = browser.run(PIXELS)
            drawn = np.frombuffer(b64decode(text), np.uint8).reshape(height, width, 4)[..., :3]
            known = to_8_bits(renderer.render(replace(view, time=moment)).image)
            assert psnr(drawn, known) > 45
        browser.key(".")
        assert browser.run("[viewer.timestamp, viewer.photographs.chosen]") == [0.6, -1], "away from it"
        skips = [browser.key(key) or browser.run("viewer.timestamp") for key in "..,,,,"]
        assert skips == [1.0, 1.0, 0.6, 0.35, 0.0, 0.0], "from one moment of the photos to the next"
        assert "was taken at another time" in browser.run("document.getElementById('caption').textContent")
        browser.run("viewer.clock.to(0.25)")
        browser.rest()
        address = browser.run("location.hash")
        assert address.endswith(";0.25")
        browser.run(f"location.hash = {address.replace(';0.25', ';0.5')!r}")
        assert browser.run("new Promise(done => setTimeout(() => done(viewer.timestamp), 100))") == 0.5
        browser.run("viewer.clock.to(0)")
        pivot = browser.run(NEAREST)
        then = model.at(browser.run("viewer.timestamp")).means
        assert np.linalg.norm(then - pivot, axis=1).min() < 2e-3, "a double click finds a splat where it is then"
        browser.key(" ")
        assert browser.run("viewer.clock.playing") is True
        browser.key(" ")
        assert browser.errors == []

"""The page in a headless browser: rendering, controls, and no network access."""

import json
import re
from base64 import b64decode
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import clsplat
from clsplat.metrics.images import psnr, to_8_bits
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer.packing import pack
from clsplat.viewer.page import Page, view_entries
from tests.support.browser import CHROMIUM, Browser
from tests.support.html_page import HOSTILE
from tests.support.viewer_pages import MIP, PLAIN, cloud, scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.large,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium: apt-get install chromium"),
]
COUNT = 4200  # splats: more than a row of each texture holds
LEAST = 45.0  # dB
LARGE, SMALL = (500, 420), (220, 260)  # windows, px
RENDERINGS = {"plain": PLAIN, "mip": MIP}
PIXELS = """(picture => {
  let letters = "";
  for (const byte of picture.data) letters += String.fromCharCode(byte);
  return [picture.width, picture.height, btoa(letters)];
})(viewer.capture())"""
POSE = "[...viewer.camera.eye, ...viewer.camera.rotation]"
AWAY = "Math.hypot(...viewer.camera.eye.map((v, i) => v - viewer.pivot[i]))"


def render(model, view):
    """What `clsplat render` writes for a view, before it is a file."""
    return to_8_bits(clsplat.Renderer(model).render(view).image)


def write_page(folder: Path, model, **names) -> Path:
    """Write a page whose photographs are renders of its model, as JPEG."""
    result = scene(folder)
    stand = Viewpoint.from_points(model.means, result.views, result.views[0])
    views = view_entries(result, lambda view: render(model, view), "test")
    for view, name in zip(views, names.get("views", ()), strict=False):
        view["name"] = name
    stand = replace(stand, start=replace(stand.start, name=views[0]["name"]))
    title = names.get("title", "demo")
    Page(title, {title: pack(model)}, stand, model.rendering.background, views).write(folder / "page.html")
    return folder / "page.html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("browser"), *LARGE) as opened:
        yield opened
        assert opened.errors == []
        assert not [url for url in opened.requests if not url.startswith(("file:", "blob:", "data:"))]


@pytest.fixture
def small(browser):
    """The browser with a small window: a processor draws it."""
    browser.resize(*SMALL)
    yield browser
    browser.resize(*LARGE)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    return write_page(tmp_path_factory.mktemp("page"), cloud(600))


@pytest.fixture
def opened(browser, page):
    browser.open(page)
    assert browser.run("viewer.at") == 0
    return browser


def screenshot(browser) -> np.ndarray:
    """Return the screen, [H, W, 3]."""
    browser.rest()
    return cv2.imdecode(np.frombuffer(browser.picture(), np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]


@pytest.mark.parametrize(("kind", "degree", "count"), [("plain", 3, COUNT), ("mip", 1, 300), ("plain", 0, 300)])
def test_page_matches_the_renderer(small, tmp_path, kind, degree, count):
    browser = small
    model = cloud(count, RENDERINGS[kind], degree)
    browser.open(write_page(tmp_path, model))
    assert browser.run("viewer.painter.half"), "half floats"
    for i, view in enumerate(scene(tmp_path).views):
        browser.run(f"viewer.photographs.choose({i}, 0)")
        browser.rest()
        width, height, data = browser.run(PIXELS)
        drawn = np.frombuffer(b64decode(data), np.uint8).reshape(height, width, 4)[:, :, :3]
        expected = render(model, view)
        assert drawn.shape == expected.shape
        assert np.ptp(expected) > 100
        assert psnr(drawn, expected) >= LEAST, view.name


def test_photograph_aligns_with_the_render(opened):
    """The photograph is a JPEG of the render: where it is shown, the screen hardly changes, and where it is shifted it
    does."""
    plain = screenshot(opened)
    opened.click("[data-comparison=fade]")
    opened.run("viewer.photographs.share = 1; viewer.photographs.place()")
    left, top, width, height = opened.run(
        "(b => [b.left, b.top, b.width, b.height])(document.querySelector('#frame').getBoundingClientRect())"
    )
    assert width / height == pytest.approx(112 / 80, abs=0.01)
    middle = np.s_[int(top + 20) : int(top + height - 90), int(left + 20) : int(left + width - 20)]
    covered = screenshot(opened)[middle]
    same = psnr(covered, plain[middle])
    shifted = psnr(covered, np.roll(plain, 4, axis=1)[middle])
    assert same > shifted + 3
    opened.click("[data-comparison=slider]")
    assert opened.run("document.querySelector('#frame img').style.clipPath") == "inset(0px 0% 0px 0px)"
    opened.drag((left + width - 1, top + height / 2), (left + width / 4, top + height / 2))
    assert opened.run("viewer.photographs.share") == pytest.approx(0.25, abs=0.01)
    assert opened.run("viewer.at") == 0, "the slider does not move the camera"
    opened.click("[data-comparison=blink]")
    opened.wait("document.querySelector('#frame img').hidden")  # the dark half of blinking
    opened.key("p")
    opened.key("p")
    assert opened.run("viewer.photographs.comparison") == "off"


def test_filmstrip_images_jump_to_their_cameras(opened):
    opened.click("#strip button:nth-child(3)")
    opened.rest()
    assert opened.run("viewer.at") == 2
    assert opened.run("document.getElementById('caption').textContent") == "0003.png"
    assert opened.run("document.querySelector('#strip [aria-current]').innerText") == "0003"
    assert opened.run("document.getElementById('comparison').hidden"), "a training view has no photo in the page"
    pose = opened.run(POSE)
    np.testing.assert_allclose(pose[:3], scene(Path()).views[2].position, atol=1e-6)
    np.testing.assert_allclose(np.reshape(pose[3:], (3, 3)), scene(Path()).views[2].world_to_camera[:, :3], atol=1e-6)
    still = {"name": "prefers-reduced-motion", "value": "reduce"}  # no flight from here on
    opened.call("Emulation.setEmulatedMedia", features=[still])
    for key, index in (("ArrowRight", 3), ("ArrowRight", 0), ("ArrowLeft", 3)):
        opened.key(key)
        opened.rest()
        assert opened.run("viewer.at") == index
    opened.key("r")
    opened.rest()
    assert opened.run("viewer.at") == 0
    opened.call("Emulation.setEmulatedMedia", features=[])


def test_mouse_and_keys_move_the_camera(opened):
    before = opened.run(POSE)
    radius = np.linalg.norm(np.subtract(before[:3], opened.run("viewer.pivot")))
    for act in (
        lambda: opened.drag((200, 150), (260, 170)),
        lambda: opened.drag((200, 150), (230, 150), "right"),
        lambda: opened.mouse("mouseWheel", 200, 150, deltaX=0, deltaY=240),
        lambda: opened.key("l"),
        lambda: opened.key("w", ("keyDown",)),
        lambda: (opened.key("o"), opened.drag((200, 150), (150, 170))),
    ):
        act()
        opened.wait(f"Math.max(...{POSE}.map((v, i) => Math.abs(v - {before}[i]))) > 1e-3")
        opened.key("w", ("keyUp",))
        opened.rest()
        after = opened.run(POSE)
        turn = np.reshape(after[3:], (3, 3))
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
        before = after
    assert opened.run("viewer.at") == -1
    assert opened.run("document.getElementById('frame').hidden"), "no photo belongs to this camera"
    assert radius > 1


def test_orbiting_keeps_the_distance_and_stays_below_the_top(opened):
    before = opened.run(AWAY)
    for _ in range(6):
        opened.drag((200, 100), (205, 300))
    assert opened.run(AWAY) == pytest.approx(before, rel=1e-6)
    assert opened.run("-viewer.camera.rotation.slice(3, 6).reduce((sum, v, i) => sum + v * viewer.up[i], 0)") > 0


def test_url_contains_the_camera(browser, page, opened):
    opened.drag((200, 150), (260, 170))
    opened.rest()
    address, pose, picture = opened.run("location.hash"), opened.run(POSE), screenshot(opened)
    assert address.startswith("#")
    browser.call("Page.navigate", url="about:blank")
    browser.open(page, address)
    np.testing.assert_allclose(browser.run(POSE), pose, atol=1e-6)
    assert np.abs(screenshot(browser).astype(int) - picture)[100:300].mean() < 0.5
    for wrong in (
        "#nonsense",
        "#1,2,3;0,0,0,0;1,1,1,1,1,1",
        "#1,2,NaN;0,0,0,1;9,9,9,9,9,9",
        "#1,2,3;0,0,0,1;0,9,9,9,9,9",
    ):
        browser.call("Page.navigate", url="about:blank")
        browser.open(page, wrong)
        assert browser.run("viewer.at") == 0, "the first view, as without an address"


def test_display_modes_differ(opened):
    pictures = [screenshot(opened)]
    for key in "234":
        opened.key(key)
        pictures.append(screenshot(opened))
    for i, one in enumerate(pictures):
        for other in pictures[:i]:
            assert np.abs(one[100:300].astype(int) - other[100:300]).mean() > 1
    opened.key("1")
    assert np.array_equal(screenshot(opened)[100:300], pictures[0][100:300])


def test_settings_help_and_hidden_controls(opened):
    hidden = "document.getElementById({}).hidden".format
    opened.click("#settings")
    assert not opened.run(hidden("'panel'"))
    opened.click("[data-background=black]")
    assert screenshot(opened)[200, 5].max() < 60
    opened.run(
        "(slider => { slider.value = 25; slider.dispatchEvent(new Event('input')); })(document.getElementById('share'))"
    )
    opened.rest()
    assert opened.run("viewer.layers[0].first") == opened.run("viewer.info.models[0].levels[1]")
    assert opened.run("document.getElementById('statistics').textContent").split()[0] <= "150"
    opened.run(
        "(slider => { slider.value = 90; slider.dispatchEvent(new Event('input')); })(document.getElementById('field'))"
    )
    opened.rest()
    assert opened.run("document.getElementById('angle').textContent") == "90°"
    assert opened.run(hidden("'frustums'"))
    opened.click("[data-cameras=shown]")
    opened.rest()
    drawn = "document.getElementById('frustums').getContext('2d').getImageData(0, 0, 500, 250).data.some(v => v > 0)"
    assert opened.run(drawn), "lines of cameras"
    opened.key("g")
    opened.rest()
    assert opened.run(hidden("'frustums'"))
    opened.click("#settings")
    assert opened.run(hidden("'panel'"))
    opened.key("?")
    assert opened.run("document.getElementById('keys').open")
    opened.click("#keys > button")
    assert not opened.run("document.getElementById('keys').open")
    opened.key("h")
    assert opened.run("document.querySelector('header').offsetHeight") == 0
    opened.rest()
    opened.click("#show")
    assert opened.run("document.querySelector('header').offsetHeight") > 20


def test_image_is_saved_as_a_file(opened):
    opened.run(
        "window.saved = []; HTMLAnchorElement.prototype.click = function () { saved.push([this.download, this.href]); }"
    )
    opened.click("#screenshot")
    ((name, address),) = opened.wait("saved.length ? saved : null")
    assert name == "demo.png"
    assert address.startswith("blob:")


def test_slow_device_draws_fewer_splats_while_moving(opened):
    wide = opened.run("viewer.canvas.width")
    opened.run("viewer.quality = 0.05; viewer.move(viewer.camera); viewer.draw(false)")
    drawn = opened.run("[viewer.painter.target.width, document.getElementById('statistics').textContent]")
    assert drawn[0] == pytest.approx(0.4 * wide, abs=1)
    assert "40 % resolution" in drawn[1]
    opened.rest()
    assert opened.run("viewer.painter.target.width") == wide
    assert opened.run("viewer.layers[0].first") == opened.run("viewer.layers[0].count")


def test_page_makes_no_requests(opened):
    for attempt in (
        "fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'refused')",
        """new Promise(done => {
          const image = new Image();
          image.onerror = () => done("refused");
          image.src = "http://127.0.0.1:9/a.png";
        })""",
        """new Promise(done => {
          document.addEventListener("securitypolicyviolation", () => done("refused"), {once: true});
          const script = document.createElement("script");
          script.textContent = "window.foreign = 1";
          document.body.append(script);
        })""",
    ):
        assert opened.run(attempt) == "refused"
    assert opened.run("window.foreign") is None
    opened.errors.clear()  # what the browser says of these attempts
    opened.requests[:] = [url for url in opened.requests if "127.0.0.1:9" not in url]


def test_hostile_names_are_text(browser, tmp_path):
    browser.open(write_page(tmp_path, cloud(50), title=HOSTILE, views=[f"{HOSTILE}/a.png", f"b/{HOSTILE}"]))
    assert browser.run("document.querySelector('h1').textContent") == HOSTILE
    assert browser.run("document.getElementById('caption').textContent") == f"{HOSTILE}/a.png"
    assert (
        browser.run("document.querySelectorAll('#strip button')[1].title") == f"b/{HOSTILE} (train), photo not included"
    )
    assert browser.run("document.querySelectorAll('script').length") == 2, "the scene and the program"


def test_two_models_share_a_camera(browser, tmp_path):
    model, other = cloud(300), cloud(300, seed=3)
    stand = Viewpoint.from_points(model.means, (), None)
    Page("two", {"a": pack(model), "b": pack(other)}, stand, "black").write(tmp_path / "page.html")
    browser.open(tmp_path / "page.html")
    picture = screenshot(browser)[70:400]
    left, right = picture[:, :250], picture[:, 250:]
    assert min(left.mean(), right.mean()) > 5
    assert np.abs(left.astype(int) - right).mean() > 5
    assert browser.run("document.getElementById('names').innerText").split() == ["a", "b"]
    told = browser.run("document.getElementById('statistics').textContent")
    counts = [pack(item).count for item in (model, other)]
    assert re.match(r"a: \d+ of {} splats.* · b: \d+ of {} splats".format(*counts), told), told
    assert browser.run("document.getElementById('strip')") is None, "there are no views"


def test_double_clicks_measure_a_distance(browser, tmp_path):
    model = cloud(2)
    model.means[:], model.logit_opacity[:], model.log_scales[:] = [[-0.5, 0, 0], [0.7, 0.1, 0.3]], 4, -3
    Page("two", {"a": pack(model)}, Viewpoint.from_points(model.means, (), None), "black").write(tmp_path / "page.html")
    browser.open(tmp_path / "page.html")
    assert browser.run("viewer.focus(1, 1)") is None, "nothing is there"
    distance = browser.run(
        "(() => { const {width, height} = viewer.pane();"
        " for (let x = 0; x < width; x += 6) for (let y = 0; y < height; y += 6)"
        " if (!viewer.distance) viewer.focus(x, y); return viewer.distance; })()"
    )
    assert distance == pytest.approx(np.linalg.norm(model.means[0] - model.means[1]), rel=1e-3)
    browser.run("viewer.draw(true)")
    assert f"distance of the last two points: {distance:.4g}" in browser.run(
        "document.getElementById('statistics').textContent"
    )


def test_empty_and_damaged_models(browser, tmp_path):
    stand = Viewpoint.from_points(cloud(4)[:0].means, (), None)
    page = tmp_path / "page.html"
    Page("nothing", {"a": pack(cloud(4)[:0])}, stand, "black").write(page)
    browser.open(page)
    assert browser.run("document.getElementById('statistics').textContent").startswith("0 of 0 splats")
    text = page.read_text()
    begin = text.index('id="model0">') + len('id="model0">')
    page.write_text(text[:begin] + "AAAA" + text[begin + 4 :])
    browser.open(page)
    assert browser.run("document.documentElement.dataset.failed") == "1"
    assert "cannot be shown" in browser.run("document.getElementById('message').textContent")


def test_touch_gestures_orbit_zoom_and_pan(page, tmp_path):
    with Browser(tmp_path, 390, 700, scale=1, touch=True) as phone:
        phone.open(page)
        first, pose = phone.run(AWAY), phone.run(POSE)
        phone.touch([(150, 300)], [(200, 310)])
        phone.rest()
        assert np.abs(np.subtract(phone.run(POSE), pose)).max() > 1e-3
        assert phone.run(AWAY) == pytest.approx(first, rel=1e-6)
        phone.touch([(150, 300), (250, 300)], [(100, 300), (300, 300)])
        phone.rest()
        assert phone.run(AWAY) == pytest.approx(first / 2, rel=0.05)
        pivot = phone.run("viewer.pivot")
        phone.touch([(150, 300), (250, 300)], [(150, 360), (250, 360)])
        phone.rest()
        assert np.abs(np.subtract(phone.run("viewer.pivot"), pivot)).max() > 1e-2
        assert phone.run("document.documentElement.scrollWidth") <= 390, "nothing is wider than the screen"
        assert (
            json.loads(
                phone.run("JSON.stringify([...document.querySelectorAll('nav button')].map(b => b.offsetHeight))")
            )[0]
            >= 40
        )
        assert phone.errors == []

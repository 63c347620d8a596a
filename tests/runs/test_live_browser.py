"""The live page in a real browser, without a display, while a run trains."""

import pytest

from clsplat.runs.live.live import Live
from clsplat.runs.live.server import FOLDER as LIVE
from clsplat.runs.live.server import SCRIPTS, render_page
from tests.support.browser import CHROMIUM, Browser
from tests.support.html_page import Page
from tests.support.live import in_background, trained

pytestmark = [pytest.mark.slow, pytest.mark.large]
NEWEST = "live.watch.live.newest"


def test_page_is_self_contained_and_its_scripts_are_short():
    text = render_page().decode()
    assert Page(text).elements["script"] == 1
    assert "default-src 'none'; img-src 'self' data:; connect-src 'self'; style-src 'sha256-" in text
    for name in SCRIPTS:
        lines = (LIVE / f"{name}.js").read_text().splitlines()
        assert len(lines) <= 250
        assert max(map(len, lines)) <= 120


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium: apt-get install chromium")
def test_late_image_does_not_replace_a_newer_one(tmp_path):
    script = (LIVE / "link.js").read_text()
    race = """(async () => {
      const shown = [], closed = [], decoded = {};
      const answer = number => ({status: 200, ok: true, blob: async () => number, headers: {get: () => number}});
      const fetch = async url => answer(+url.split("view=")[1]);
      const createImageBitmap = number => new Promise(ready => {
        decoded[number] = () => ready({close: () => closed.push(number)});
      });
      %s
      Link.prototype.poll = () => {};
      const link = new Link({nextRequest: () => null, show: ({number}) => shown.push(number)}), pause = () =>
        new Promise(later => setTimeout(later, 10));
      const asked = [1, 2].map(number => link.load({number, key: `view=${number}`, pace: "still"}));
      for (const number of [2, 1]) { await pause(); decoded[number](); }
      await Promise.all(asked);
      return [shown, closed];
    })()"""
    with Browser(tmp_path, 300, 200) as browser:
        assert browser.run(race % script) == [[2], [1]]


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium: apt-get install chromium")
def test_page_works_from_the_first_step_to_the_end(tiny_scene, tmp_path):
    with Live() as live, Browser(tmp_path / "browser", 700, 620) as browser:
        live.state.set_paused(True)

        def visit():
            browser.visit(live.address)  # at rest: it shows a picture of step 1
            assert browser.run(f"{NEWEST}.step") == 1
            assert browser.run("document.querySelector('h1').textContent") == "smoke · tiny"
            assert browser.run("document.title") == "smoke · tiny"
            assert "paused · step 1 of 12" in browser.run("document.getElementById('state').textContent")
            assert browser.run("document.querySelectorAll('#strip button').length") == 10
            _look_at_a_photograph(browser)
            _move(browser)
            browser.click("#help")
            port = live.address.split(":")[2].split("/")[0]
            assert f"ssh -L {port}:127.0.0.1:{port} " in browser.run("document.getElementById('tunnel').textContent")
            browser.click("#keys > button")
            assert browser.run("document.getElementById('pause').textContent") == "Resume"
            browser.click("#pause")
            browser.wait("!document.getElementById('notice').hidden")
            assert browser.run("document.getElementById('notice').textContent").startswith("The run is done; ")
            assert browser.run("document.querySelector('#loss polyline').getAttribute('points').split(' ').length") == 3
            assert browser.run("document.querySelector('#gaussians b').textContent") != "–"
            assert browser.run("document.getElementById('pause').hidden")
            assert browser.run("document.getElementById('state').textContent") == "finished · step 12 of 12"

        with in_background(visit):
            trained(live, tiny_scene, tmp_path / "run")
            live.close()
        assert browser.errors == []
        assert all(url.startswith((live.address, "blob:", "data:")) for url in browser.requests)


def _look_at_a_photograph(browser):
    """The strip leads to the exact camera, and the photograph lies over it."""
    browser.run("document.querySelector('#strip button:nth-child(2)').click()")
    browser.wait(f"live.watch.live.at === 1 && {NEWEST}.key === 'view=1' && {NEWEST}.pace === 'still'")
    assert browser.run(f"[{NEWEST}.bitmap.width, {NEWEST}.bitmap.height]") == [40, 40]
    browser.click("[data-comparison=fade]")
    browser.wait("document.querySelector('#frame img').naturalWidth === 40")
    assert browser.run("document.querySelector('#frame img').hidden") is False
    browser.key("p")
    assert browser.run("document.querySelector('#frame img').hidden") is True


def _move(browser):
    """A drag turns the camera, and a picture of the new one follows."""
    before = browser.run("live.watch.live.camera.eye")
    browser.drag((300, 200), (360, 220))
    browser.wait(f"{NEWEST}.key.startsWith('camera=') && {NEWEST}.pace === 'still'")
    assert browser.run("live.watch.live.camera.eye") != before
    assert max(browser.run(f"[{NEWEST}.bitmap.width, {NEWEST}.bitmap.height]")) == 400
    browser.rest()
    assert browser.run("location.hash").count(";") == 2

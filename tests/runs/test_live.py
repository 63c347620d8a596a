"""A run with a live page: the same bits, pauses, and its end."""

import http.client
import json
import os
import shutil
import signal
import time
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from clsplat.core.errors import ConfigError, Interrupted, MemoryLimitError
from clsplat.core.progress import Progress
from clsplat.metrics.views import render_view
from clsplat.render.painter import SplatPainter
from clsplat.runs.live import live as module
from clsplat.runs.live.live import Live
from clsplat.runs.live.preview import MAX_POINTS, QUALITY, SIDES, TARGET_TIMES, Credit, Curves, Preview, PreviewRequest
from clsplat.scene.detect import read_scene
from clsplat.sweeps.experiment import Job
from tests.support.live import in_background, trained
from tests.support.runs import FEW, digest

pytestmark = pytest.mark.slow


class Client:
    """A stand-in for the browser."""

    def __init__(self, live: Live) -> None:
        parts = urlsplit(live.address)
        self.path, self.connection = parts.path, http.client.HTTPConnection(parts.netloc, timeout=30)

    def get(self, target: str) -> tuple[int, bytes, dict[str, str]]:
        self.connection.request("GET", self.path + target)
        answer = self.connection.getresponse()
        return answer.status, answer.read(), dict(answer.headers)

    def json(self, target: str):
        status, body, _ = self.get(target)
        assert status == 200, body
        return json.loads(body)

    def until(self, what):
        """Return the state as soon as it is as expected."""
        for _ in range(600):
            state = self.json("state.json?after=0")
            if what(state):
                return state
            time.sleep(0.02)
        raise AssertionError(state)


@pytest.fixture
def live():
    with Live() as opened:
        opened.state.budget = Credit(1e9, 1e9)  # pictures at every step
        yield opened


def test_live_page_does_not_change_the_bits(live, few_steps, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "END_TIMEOUT", 30.0)  # it ends as soon as the page has heard
    client, seen = Client(live), {}

    def look():
        state = client.until(lambda state: state.get("drawn"))
        assert state["paused"]
        scene = client.json("scene.json")
        views = read_scene(tiny_scene, 8).views
        assert [view["name"] for view in scene["views"]] == [view.name for view in views]
        status, body, headers = client.get("frame.jpg?page=1&pace=still&view=0")
        assert (status, headers["X-Step"]) == (200, "1")
        assert cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR).shape == (40, 40, 3)
        for kind in ("thumbnail", "photograph"):
            status, body, _ = client.get(scene["views"][1][kind])
            assert status == 200
            pixels = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
            assert np.abs(pixels - 255 * views[1].photograph(1.0)).mean() < 6
        assert client.get("photograph.jpg?view=1&scene=7")[0] == 404
        assert client.get("frame.jpg?page=1&pace=still&view=10")[0] == 400
        assert client.get("frame.jpg?page=1&pace=later&view=1")[0] == 400
        assert client.get("frames")[0] == 404
        assert client.json("resume") == {"paused": False}
        while not (state := client.json("state.json?after=5"))["ended"]:
            camera = "0,0.5,-4;0,0,0.1,1;300,300,250,100,500,200"
            status, _, headers = client.get(f"frame.jpg?page=1&pace=moving&camera={camera}")
            seen[headers.get("X-Step")] = status
            if state["state"] in ("done", "failed"):
                time.sleep(0.05)
        seen["end"] = state

    live.state.set_paused(True)
    with in_background(look):
        trained(live, tiny_scene, tmp_path / "run")
        live.close()
    assert digest(tmp_path / "run") == digest(few_steps)
    assert len({int(step) for step, status in seen.items() if step not in ("end", None) and status == 200}) >= 6, seen
    assert seen["end"]["state"] == "done"
    assert [point[0] for point in seen["end"]["points"]] == [10, 12]


def test_title_names_the_given_folder(live, tiny_scene, tmp_path, monkeypatch):
    """Not that of the prepared photographs, whose name is a hash."""
    prepared = tmp_path / "undistort-f22e16004ac0"
    shutil.copytree(tiny_scene, prepared)
    monkeypatch.setattr("clsplat.runs.opening.read_scene", lambda folder, holdout: read_scene(prepared, holdout))
    trained(live, tiny_scene, tmp_path / "run")
    assert live.state.run.title == f"smoke · {tiny_scene.name}"


def test_nothing_is_drawn_without_viewers(live, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(Preview, "draw", lambda *_: pytest.fail("a picture that nobody asked for"))
    trained(live, tiny_scene, tmp_path / "run")


def test_pause_ends_by_itself_when_no_page_is_open(live, tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "PAUSE_TIMEOUT", 0.3)
    live.state.set_paused(True)
    trained(live, tiny_scene, tmp_path / "run")
    assert not live.state.is_paused


def test_signal_ends_a_pause_and_saves_the_state(live, tiny_scene, tmp_path):
    client = Client(live)

    def stop():
        client.until(lambda state: state.get("drawn") and state.get("stage") == "paused")
        os.kill(os.getpid(), signal.SIGTERM)

    live.state.set_paused(True)
    with in_background(stop), pytest.raises(Interrupted, match="stopped at step 1, saved in "):
        trained(live, tiny_scene, tmp_path / "run")


def test_undrawable_image_is_reported_and_training_continues(live, tiny_scene, tmp_path, monkeypatch):
    def refused(self, order):
        raise MemoryLimitError("no room")

    monkeypatch.setattr(Preview, "draw", refused)
    client = Client(live)

    def look():
        client.until(lambda state: state.get("drawn"))
        assert client.get("frame.jpg?page=1&pace=still&view=0")[0] == 204
        assert client.json("state.json?after=0")["fault"] == "no room"
        client.get("resume")

    live.state.set_paused(True)
    with in_background(look):
        trained(live, tiny_scene, tmp_path / "run")


def test_live_renders_wait_for_their_time_budget(live, tiny_scene, tmp_path):
    """Without credit no picture is drawn, however often it is asked for."""
    live.state.budget = Credit(0.0, 1.0)
    client, answers = Client(live), []

    def look():
        client.until(lambda state: state.get("drawn"))
        answers.append(client.get("frame.jpg?page=1&pace=moving&view=0")[0])

    with in_background(look):
        trained(live, tiny_scene, tmp_path / "run")
        live.close()
    assert answers == [204]
    assert live.state.budget.spent == 0


def test_server_ends_with_the_run(tiny_scene, tmp_path, capsys):
    job = Job.open("smoke", tiny_scene, tmp_path / "run", FEW)
    job.run(live=0)
    shown = capsys.readouterr().out
    address = next(word for word in shown.split() if word.startswith("http://127.0.0.1:"))
    port = urlsplit(address).port
    assert len(urlsplit(address).path.strip("/")) >= 22, "128 bits"
    assert f"ssh -L {port}:127.0.0.1:{port} HOST" in shown
    assert address not in (tmp_path / "run" / "log.txt").read_text(), "others may read it"
    with pytest.raises(ConnectionRefusedError):
        http.client.HTTPConnection("127.0.0.1", port).request("GET", "/")


def test_used_port_is_refused_before_the_run(live, tiny_scene, tmp_path):
    port = urlsplit(live.address).port
    with pytest.raises(ConfigError, match=f"port {port} of 127.0.0.1 cannot be used"):
        Job.open("smoke", tiny_scene, tmp_path / "run", FEW).run(live=port)
    assert not (tmp_path / "run").exists()


def test_live_image_of_a_view_is_its_render(live, tiny_scene, tmp_path):
    run = trained(live, tiny_scene, tmp_path / "run")
    for view in run.scene.views[:3]:
        jpeg = Preview(run).draw(PreviewRequest(1, view, "still")).jpeg
        photograph = run.photographs.get(view)
        render = render_view(SplatPainter(run.rasterizer, run.model, run.photographs.background), photograph.camera)
        assert np.ptp(render) > 60
        _, data = cv2.imencode(".jpg", np.ascontiguousarray(render[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        assert jpeg == data.tobytes()


def test_image_size_adapts_to_the_render_time():
    preview = Preview.__new__(Preview)
    preview._costs = {}
    assert preview._side("moving") == SIDES[0]
    preview._costs[SIDES[0]] = 2 * TARGET_TIMES["moving"]
    assert preview._side("moving") < SIDES[0]
    assert preview._side("still") == SIDES[0]
    preview._costs = dict.fromkeys(SIDES, 9.0)
    assert preview._side("still") == SIDES[-1]


def test_curves_stay_short_and_keep_their_ends():
    curves = Curves([])
    for step in range(1, 3 * MAX_POINTS):
        curves.add(Progress(step, 9000, 0.1, 20.0, 7, 1.0, 1.0))
    points = curves.after(0)
    assert len(points) <= MAX_POINTS
    assert (points[0][0], points[-1][0]) == (1, 3 * MAX_POINTS - 1)
    assert curves.after(3 * MAX_POINTS - 2) == points[-1:]

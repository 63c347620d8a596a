"""Progress of work on the host: listeners, and the remaining time."""

import io
import threading
from collections.abc import Iterator

import pytest

from clsplat.core import progress, terminal
from clsplat.core.progress import ItemCounter, Progress, clock_text, listening, polled
from clsplat.prepare.cache import PlannedStep, prepare
from clsplat.prepare.gather import summarize_placement
from clsplat.prepare.steps import FindFeatures, MapCameras
from clsplat.runs.opening import READ_SCENE, count_listener
from clsplat.training.status import StatusFile


@pytest.fixture
def now(monkeypatch):
    """The time, which only the test advances."""
    clocked = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clocked[0])
    return clocked


def test_time_left_follows_from_work_of_this_call(now):
    counter = ItemCounter("photographs", 30)
    assert counter.seconds_left is None
    now[0] += 10
    counter.reach(5)
    assert counter.seconds_left == 50
    now[0] += 50
    counter.reach(30)
    assert counter.seconds_left == 0


def test_work_of_an_earlier_call_takes_no_time(now, monkeypatch):
    began = ItemCounter("photographs", 30)
    began.reach(20)  # at once: it was there
    now[0] += 5
    began.reach(25)
    assert began.seconds_left == pytest.approx(5, rel=0.9)


def test_uneven_work_has_no_time_left(now):
    counter = ItemCounter("steps of the preparation", 4, is_uniform=False)
    now[0] += 10
    counter.reach(1)
    assert counter.seconds_left is None


def test_empty_count_is_not_reported(tmp_path):
    heard = []
    with listening(lambda *what, seconds_left: heard.append((*what, seconds_left))):
        prepare([], tmp_path, tmp_path)
        ItemCounter("photographs", 0).reach(0)
        assert heard == []
        planned = [PlannedStep(MapCameras(), "", "", tmp_path, "")] * 2
        prepare(planned, tmp_path, tmp_path)
    assert heard == [("steps of the preparation", done, 2, None) for done in (0, 0, 1)]


def test_nested_listeners_all_hear(now):
    inner, outer = [], []
    with (
        listening(lambda *what, seconds_left: outer.append((*what, seconds_left))),
        listening(lambda *what, seconds_left: inner.append(what)),
    ):
        counter = ItemCounter("pairs", 4)
        now[0] += 3
        counter.reach(1)
    ItemCounter("others", 1)
    assert inner == [("pairs", 0, 4), ("pairs", 1, 4)]
    assert outer == [("pairs", 0, 4, None), ("pairs", 1, 4, 9)]


def test_uncounted_work_is_polled(monkeypatch):
    monkeypatch.setattr(progress, "MIN_POLL_INTERVAL", 0.001)
    heard, seen = [], threading.Event()

    def listen(what, done, total, /, *, seconds_left):
        heard.append(done)
        if done == 2:
            seen.set()

    with listening(listen), polled(ItemCounter("pairs", 9), lambda: 2):
        assert seen.wait(5)
    assert heard == [0, 2]
    assert not [thread for thread in threading.enumerate() if thread.name == "count"]


def test_no_time_left_is_shown_while_preparation_steps_remain(tmp_path):
    status = StatusFile(tmp_path)
    listen = count_listener(status)
    for stage, left in (("match_features", None), (READ_SCENE, 4), ("undistort", None)):
        with status.stage(stage):
            listen("pairs", 3, 9, seconds_left=4.0)
            assert status.now.seconds_left == left
            assert status.now.progress.unit == "pairs"
    status.note(seconds_left=4)
    status.enter("running")
    assert status.now.seconds_left is None


def test_bar_is_shown_on_a_terminal_and_not_in_a_pipe(monkeypatch, capsys):
    with terminal.counts_on_terminal():
        ItemCounter("pairs matched", 4).reach(2)
    assert capsys.readouterr().out == ""
    console = terminal.Console(force_terminal=True, width=100)
    monkeypatch.setattr(terminal, "CONSOLE", console)
    with console.capture() as shown, terminal.counts_on_terminal():
        ItemCounter("pairs matched", 4).reach(2)
    assert "pairs matched: 2 of 4" in shown.get()


@pytest.fixture
def screen(monkeypatch) -> io.StringIO:
    """What a terminal shows, of stdout and of stderr."""
    shown = io.StringIO()
    for name in ("CONSOLE", "STDERR_CONSOLE"):
        console = terminal.Console(file=shown, force_terminal=True, width=120, highlight=False)
        monkeypatch.setattr(terminal, name, console)
    return shown


@pytest.fixture
def log_shown(screen) -> Iterator[None]:
    before = progress.LOG.handlers[:], progress.LOG.level
    terminal.start_logging(debug=False, console=terminal.CONSOLE)
    yield
    progress.LOG.handlers[:] = before[0]
    progress.LOG.setLevel(before[1])


def text_of(bar: "terminal._RunBar") -> str:
    return bar.__rich__().tasks[0].description


def test_bar_of_a_run_moves_between_reports(tmp_path, monkeypatch):
    status, now = StatusFile(tmp_path), [100.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    bar = terminal._RunBar(status)
    status.note(stage="optimize")
    assert text_of(bar) == "optimize"
    status.count("steps", 1, 90, step=1, steps=90)
    assert text_of(bar) == "step 1/90"
    now[0] += 10
    status.count("steps", 3, 90, step=3, steps=90)
    assert text_of(bar) == "step 3/90  about 7:15 left"
    bar.report(Progress(10, 90, 0.1, 20.0, 1000, 5.0, 80.0))
    now[0] += 20
    status.count("steps", 30, 90, step=30, steps=90)
    assert text_of(bar) == "step 30/90  loss 0.1000  psnr 20.0  gaussians 1,000  5.0 ms/step  1:00 left"
    assert (bar.bar.tasks[0].completed, bar.bar.tasks[0].total) == (30, 90)
    status.note(stage="evaluate")
    status.count("views", 2, 8)
    assert text_of(bar) == "evaluate: 2 of 8 views"


def test_warnings_are_printed_above_the_bar(screen, log_shown):
    with terminal.counts_on_terminal():
        ItemCounter("pairs matched", 4)
        terminal.LOG.warning("cannot be renamed")
        text = screen.getvalue()
    before = text[: text.index("warning: cannot be renamed")]
    assert before.endswith("\x1b[2K"), (before, text)


def test_counts_are_not_printed_above_the_bar(now, screen, log_shown):
    with terminal.counts_on_terminal():
        counter = ItemCounter("pairs matched", 4)
        now[0] += 9
        counter.reach(2)
    assert "pairs matched: 2 of 4, 0:09 left" not in screen.getvalue()
    counter = ItemCounter("pairs matched", 4)
    now[0] += 9
    counter.reach(2)
    assert "pairs matched: 2 of 4, 0:09 left" in screen.getvalue()


def test_mapping_summary_counts_registered_photographs():
    figures = {"registered": 32, "not_registered": ["IMG_0034.jpg"], "points": 9, "error_px": 1.268}
    step = MapCameras(stage="map_cameras")
    assert step.summary(figures) == "32 of 33 photos registered, reprojection error 1.27 px; left out: IMG_0034.jpg"
    assert step.summary({**figures, "not_registered": []}) == "32 of 32 photos registered, reprojection error 1.27 px"
    many = step.summary({**figures, "not_registered": [f"{i}.jpg" for i in range(20)]})
    assert many.endswith("6.jpg, 7.jpg, and 12 more")


def test_unreadable_photographs_are_counted():
    features = {"photographs": 4, "cameras": 2, "damaged": {"b.jpg": "not an image"}}
    assert FindFeatures(stage="find_features").summary(features) == "features found in 4 photos from 2 cameras"
    cameras = {"registered": 3, "not_registered": ["c.jpg"], "error_px": 0.5}
    text = summarize_placement({"find_features": features, "map_cameras": cameras})
    assert text == "3 of 5 photos registered, reprojection error 0.50 px; left out: b.jpg (not an image), c.jpg"
    assert summarize_placement({"find_features": "damaged", "map_cameras": cameras}) == ""


def test_times_are_formatted_like_a_clock():
    assert [clock_text(seconds) for seconds in (0, 59.6, 3600, 3725)] == ["0:00", "1:00", "1:00:00", "1:02:05"]

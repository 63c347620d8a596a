"""Requests of the live page: which are accepted."""

import json

import pytest

from clsplat.runs.live.preview import LiveState
from clsplat.runs.live.server import (
    Handlers,
    Request,
    RequestError,
    host_name,
    parse_camera,
    parse_request,
    parse_timestamp,
)

TOKEN = "secret-token"


def refusal(target: str, host: str = "localhost") -> int:
    with pytest.raises(RequestError) as caught:
        parse_request(target, host, TOKEN)
    return caught.value.response.status


def test_request_has_a_path_after_the_secret_and_fields():
    request = parse_request(f"/{TOKEN}/state.json?after=3", "localhost", TOKEN)
    assert (request.path, request.query) == ("state.json", {"after": "3"})
    assert request.number("after", 0, 9) == 3
    assert parse_request(f"/{TOKEN}/", "localhost", TOKEN).path == ""


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:9000", "[::1]:80", "LocalHost:1"])
def test_local_host_names_are_accepted_at_every_port(host):
    """A tunnel may end at another port."""
    assert parse_request(f"/{TOKEN}/state.json", host, TOKEN).path == "state.json"


@pytest.mark.parametrize("host", ["evil.example:8710", "127.0.0.1.evil.example", "localhost.evil", ""])
def test_rebound_host_name_is_refused(host):
    assert refusal(f"/{TOKEN}/", host) == 403


@pytest.mark.parametrize("target", ["/state.json", "/secret-toke/", "/secret-token2/x", "/%FF/", "//x/", "", "/é/"])
def test_requests_without_the_secret_get_404(target):
    assert refusal(target) == 404


@pytest.mark.parametrize("target", ["/secret-token/?" + "a=1&" * 50, "//["])
def test_invalid_address_is_refused(target):
    assert refusal(target) == 400


@pytest.mark.parametrize("text", ["", "-1", "10", "1.0", "१", "9" * 4000])
def test_number_fields_are_validated(text):
    request = parse_request(f"/{TOKEN}/?view=5", "localhost", TOKEN)
    request.query["view"] = text
    with pytest.raises(RequestError, match="view: expected a whole number from 0 to 9"):
        request.number("view", 0, 9)


def test_host_name_omits_the_port():
    assert [host_name(text) for text in ("a:1", "a", "[::1]:5", "a:b")] == ["a", "a", "[::1]", "a:b"]


def test_camera_is_read_as_the_page_writes_it():
    view = parse_camera("1,2,3;0,0,0.70710678,0.70710678;100,110,50,40,101,81")
    assert view.position == pytest.approx([1, 2, 3])
    assert view.world_to_camera[:, :3].tolist() == [pytest.approx(row) for row in ([0, -1, 0], [1, 0, 0], [0, 0, 1])]
    assert (view.camera.width, view.camera.height, view.camera.fy) == (101, 81, 110)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1,2,3;0,0,0,1",
        "1,2;0,0,0,1;9,9,5,5,10,10",
        "nan,2,3;0,0,0,1;9,9,5,5,10,10",
        "1,2,inf;0,0,0,1;9,9,5,5,10,10",
        "1,2,3;0,0,0,0;9,9,5,5,10,10",
        "1,2,3;0,0,0,1;0,9,5,5,10,10",
        "1,2,3;0,0,0,1;9,-9,5,5,10,10",
        "1,2,3;0,0,0,1;9,9,5,5,0,10",
        "1,2,3;0,0,0,1;9,9,5,5,10,1000000",
        "1,2,3;0,0,0,1;9,9,5,5,10,1000",
        "1,2,3;0,0,0,1;9,9,1e300,5,10,10",
        "a,2,3;0,0,0,1;9,9,5,5,10,10",
    ],
)
def test_impossible_camera_is_refused(text):
    with pytest.raises(RequestError, match="camera: expected"):
        parse_camera(text)


@pytest.mark.parametrize("text", ["x", "nan", "1.01", "-0.1"])
def test_time_is_from_0_to_1(text):
    assert parse_timestamp("0.35") == 0.35
    with pytest.raises(RequestError, match="time: expected a timestamp from 0"):
        parse_timestamp(text)


def test_page_that_missed_the_end_is_not_counted_as_informed():
    class Ending(LiveState):
        looks = 0

        @property
        def has_ended(self) -> bool:  # it ends while the answer is made
            self.looks += 1
            return self.looks > 1

        @has_ended.setter
        def has_ended(self, _: bool) -> None: ...

    desk = Ending()
    state = json.loads(Handlers(desk)(Request("state.json", {})).body)
    assert desk.is_end_sent == state["ended"]

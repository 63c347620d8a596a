"""Datasets from the web: verified, resumed, and unpacked only in their folder."""

import functools
import hashlib
import http.server
import io
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import ConfigError
from clsplat.data_tools import fetch as fetching
from clsplat.data_tools.fetch import WebArchive, fetch, find_source
from tests.support.refusals import refusal


class Server(http.server.SimpleHTTPRequestHandler):
    """Serve a folder, with ranges if `ranges`, and break off after some bytes, `breaks` times."""

    ranges, breaks, after = True, 0, 1000
    asked: list[str]

    def do_GET(self) -> None:
        path = Path(self.translate_path(self.path))
        wanted = self.headers.get("Range", "")
        type(self).asked.append(wanted)
        if not path.is_file():
            self.send_error(404)
            return
        content, start = path.read_bytes(), 0
        if self.ranges and wanted:
            start = int(wanted.removeprefix("bytes=").rstrip("-"))
            if start >= len(content):
                self.send_error(416)
                return
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(content) - start))
        self.end_headers()
        if type(self).breaks > 0:
            type(self).breaks -= 1
            self.wfile.write(content[start : start + self.after])
            self.close_connection = True
        else:
            self.wfile.write(content[start:])

    def log_message(self, format: str, *arguments: object) -> None:
        pass


@pytest.fixture
def web(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Path, str, type[Server]]]:
    """A folder, its address, and the server's behavior."""
    folder = tmp_path / "web"
    folder.mkdir()
    behavior = type("Behavior", (Server,), {"asked": []})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(behavior, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setattr(fetching, "PAUSE", 0)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    yield folder, f"http://127.0.0.1:{server.server_port}", behavior
    server.shutdown()
    server.server_close()


def archive(path: Path, names: tuple[str, ...] = ("scene/a.txt", "scene/ü/b.txt")) -> str:
    """A ZIP of incompressible files; its checksum."""
    rng = np.random.default_rng(0)
    with zipfile.ZipFile(path, "w") as zipped:
        for name in names:
            zipped.writestr(name, rng.bytes(3000))
    return hashlib.sha256(path.read_bytes()).hexdigest()


def quietly(source: WebArchive, out: Path) -> list[str]:
    lines: list[str] = []
    fetch(source, out, lines.append)
    return lines


def test_archive_is_downloaded_only_once(web, tmp_path):
    folder, address, server = web
    checksum = archive(folder / "d.zip")
    quietly(WebArchive(f"{address}/d.zip", "free", checksum), tmp_path / "data" / "d")
    assert (tmp_path / "data" / "d" / "scene" / "ü" / "b.txt").stat().st_size == 3000
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["d"]
    assert quietly(WebArchive(f"{address}/d.zip", "free"), tmp_path / "data" / "d")[0].endswith("nothing to do")
    assert len(server.asked) == 1


@pytest.mark.parametrize("ranges", [True, False])
def test_broken_download_resumes(web, tmp_path, ranges):
    folder, address, server = web
    checksum = archive(folder / "d.zip")
    server.breaks, server.ranges = 3, ranges
    quietly(WebArchive(f"{address}/d.zip", "free", checksum), tmp_path / "d")
    assert (tmp_path / "d" / "scene" / "a.txt").is_file()
    assert server.asked == ["", "bytes=1000-", "bytes=2000-", "bytes=3000-"] if ranges else ["", *["bytes=1000-"] * 3]


def test_partial_download_is_kept_after_retries(web, tmp_path):
    folder, address, server = web
    checksum = archive(folder / "d.zip")
    server.breaks = 5
    source = WebArchive(f"{address}/d.zip", "free", checksum)
    assert "run the command again to continue from 5000 bytes" in refusal(quietly, source, tmp_path / "d")
    assert [path.name for path in tmp_path.iterdir() if path.name != "web"] == ["d.d.zip.part"]
    quietly(source, tmp_path / "d")
    assert server.asked[-1] == "bytes=5000-"


def test_archive_with_a_wrong_checksum_is_refused(web, tmp_path):
    folder, address, _ = web
    archive(folder / "d.zip")
    message = refusal(quietly, WebArchive(f"{address}/d.zip", "free", "0" * 64), tmp_path / "d")
    assert "expected 0000" in message
    assert [path.name for path in tmp_path.iterdir()] == ["web"]
    assert any("no checksum is known" in line for line in quietly(WebArchive(f"{address}/d.zip", ""), tmp_path / "d"))


@pytest.mark.parametrize("name", ["../evil.txt", "/evil.txt", "C:\\evil.txt", "a/../../evil.txt"])
def test_archive_members_outside_the_folder_are_refused(web, tmp_path, name):
    folder, address, _ = web
    archive(folder / "d.zip", ("scene/a.txt", name))
    assert "outside its folder" in refusal(quietly, WebArchive(f"{address}/d.zip", ""), tmp_path / "d")
    assert not (tmp_path / "d").exists()
    assert not list(tmp_path.rglob("evil.txt"))


def test_tar_links_are_left_out(web, tmp_path):
    folder, address, _ = web
    with tarfile.open(folder / "d.tar.gz", "w:gz") as tarred:
        info = tarfile.TarInfo("scene/a.txt")
        info.size = 3
        tarred.addfile(info, io.BytesIO(b"abc"))
        link = tarfile.TarInfo("scene/link")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tarred.addfile(link)
    quietly(WebArchive(f"{address}/d.tar.gz", ""), tmp_path / "d")
    assert [path.name for path in (tmp_path / "d" / "scene").iterdir()] == ["a.txt"]


def test_unfetchable_data_is_refused(web, tmp_path):
    folder, address, _ = web
    (folder / "page.html").write_text("hello")
    assert "the server sent 404" in refusal(quietly, WebArchive(f"{address}/none.zip", ""), tmp_path / "d")
    assert "expected a ZIP or TAR archive" in refusal(quietly, WebArchive(f"{address}/page.html", ""), tmp_path / "d")
    with pytest.raises(ConfigError, match="no dataset is named 'garden'; use one of mipnerf360"):
        find_source("garden")
    assert not (tmp_path / "d").exists()

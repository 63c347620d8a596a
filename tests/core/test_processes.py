"""Owners of files and folders, and whether their process is alive."""

import sys
from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest

from clsplat.core import machine
from clsplat.core.machine import Owner


def test_process_id_is_local_to_its_namespace(monkeypatch):
    this = Owner.current()
    assert this.is_local
    assert not this.has_ended
    assert Owner.from_record(asdict(this)) == this
    assert Owner.from_record({"process": this.process}) == this, "an older file says no more"
    for elsewhere in ({"host": "another"}, {"pid_namespace": "pid:[1]"}):
        monkeypatch.setattr(machine, "is_alive", lambda process: False)
        other = replace(this, **elsewhere)
        assert not other.is_local
        assert not other.has_ended, "nothing is known of it"
    assert this.has_ended


def test_process_from_before_a_reboot_has_ended(monkeypatch, tmp_path):
    """Its number may be another's by now.  In containers, host name and namespace may be those of two machines."""
    boot = tmp_path / "boot_id"
    monkeypatch.setattr(machine, "BOOT_ID", boot)
    for namespace, ended in ((machine.FIRST_PID_NAMESPACE, True), ("pid:[4026532000]", False), (None, False)):
        monkeypatch.setattr(machine, "_pid_namespace", lambda namespace=namespace: namespace)
        boot.write_text("first\n")
        before = Owner.current()
        assert (before.boot, before.is_local, before.has_ended) == ("first", True, False)
        boot.write_text("second\n")
        assert (before.is_local, before.has_ended) == (False, ended)
        assert not replace(before, host="another").has_ended
        older = {key: value for key, value in asdict(before).items() if key != "boot"}
        assert Owner.from_record(older) == Owner.current(), "an older file does not say"
        boot.unlink()
        assert Owner.current().boot is None
        assert not before.has_ended, "nothing is known of it"


@pytest.mark.parametrize("process", [None, "7", 7.0, True, 0, -1])
def test_file_without_a_process_has_no_owner(process):
    assert Owner.from_record({"process": process, "host": "a"}) is None


class Function:
    """A function of a Windows library, which takes the type of its result."""

    def __init__(self, call) -> None:
        self.call = call

    def __call__(self, *arguments):
        return self.call(*arguments)


@pytest.mark.parametrize(
    ("code", "error", "alive"), [(259, 0, True), (1, 0, False), (None, 87, False), (None, 5, True)]
)
def test_windows_process_is_probed_without_ending_it(code, error, alive, monkeypatch):
    """As Windows answers: the exit code of a process, or the error where there is none or it is another user's."""
    handles: list[int] = []

    def opened(rights, inherited, process):
        if code is not None:
            handles.append(process)
        return process if code is not None else None

    def asked(handle, place):
        place._obj.value = code
        return 1

    kernel = SimpleNamespace(
        OpenProcess=Function(opened),
        GetExitCodeProcess=Function(asked),
        CloseHandle=Function(lambda handle: handles.remove(handle.value)),
    )
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(machine.ctypes, "WinDLL", lambda name, use_last_error: kernel, raising=False)
    monkeypatch.setattr(machine.ctypes, "get_last_error", lambda: error, raising=False)
    monkeypatch.setattr(machine.os, "kill", lambda *arguments: pytest.fail("it would end the process"))
    assert machine.is_alive(1234) is alive
    assert handles == [], "the handle is closed"

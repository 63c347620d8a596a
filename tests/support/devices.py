"""The devices and schedules that kernel tests run on."""

import os

import pytest

NAMES = [name.strip() for name in os.environ.get("CLSPLAT_TEST_DEVICES", "").split(";")]


TUNINGS = {"wide16": ("wide", 16), "wide8": ("wide", 8), "simt": ("simt", 1)}

# For tests of what runs on the host alone: `device` is one of the three.
one_schedule = pytest.mark.parametrize("device", [(NAMES[0], "wide16")], ids="-".join, indirect=True)

"""The devices and schedules that kernel tests run on."""

import os

NAMES = [name.strip() for name in os.environ.get("CLSPLAT_TEST_DEVICES", "").split(";")]


TUNINGS = {"wide16": ("wide", 16), "wide8": ("wide", 8), "simt": ("simt", 1)}

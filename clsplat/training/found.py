"""What the steps of `prepare` have found, in words."""

from collections.abc import Mapping
from typing import Any

NAMES_SHOWN = 8


def photographs_text(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return how many photographs have cameras, how well these fit, and which are left out; "" where it is not known.

    found: of `facts`; the error is the mean distance in px between points and their features.
    """
    cameras = found.get("map_cameras", {})
    try:
        placed, lost = int(cameras["registered"]), [str(name) for name in cameras["not_registered"]]
        text = f"{placed} of {placed + len(lost)} photographs placed, {float(cameras['error_px']):.2f} px"
    except (KeyError, TypeError, ValueError):
        return ""
    names = ", ".join(lost[:NAMES_SHOWN]) + (f", and {len(lost) - NAMES_SHOWN} more" if len(lost) > NAMES_SHOWN else "")
    return text + (f"; left out: {names}" if lost else "")

"""What the steps of `prepare` have found, in words."""

from collections.abc import Mapping
from typing import Any

from clsplat.errors import first_few


def photographs_text(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Return how many photographs have cameras, how well these fit, and which are left out; "" where it is not known.

    found: of `facts`; the error is the mean distance in px between points and their features.
    """
    cameras = found.get("map_cameras", {})
    try:
        damaged = [f"{name} ({reason})" for name, reason in found.get("find_features", {}).get("damaged", {}).items()]
        why = cameras.get("reasons", {})
        missing = [f"{name} ({why[name]})" if name in why else str(name) for name in cameras["not_registered"]]
        placed, lost = int(cameras["registered"]), [*damaged, *missing]
        text = f"{placed} of {placed + len(lost)} photographs placed, {float(cameras['error_px']):.2f} px"
    except (AttributeError, KeyError, TypeError, ValueError):
        return ""
    return text + (f"; left out: {first_few(lost)}" if lost else "")


def size_text(gaussians: int | None, parameters: int | None) -> str:
    """Return how large what was trained is, in words."""
    return f"{parameters or 0:,} parameters" if gaussians is None else f"{gaussians:,} Gaussians"

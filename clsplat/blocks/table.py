"""A partition as a table in text."""

from typing import Any

from clsplat.pages.columns import columns

HEADINGS = ("block", "owns", "starts from", "views", "of these by place", "pairs", "MiB")


def table(found: dict[str, Any]) -> str:
    """Return a manifest as lines of text; MiB are those on the device at the beginning of a training."""
    whole = ["whole", *[f"{found['gaussians']:,}"] * 2, str(found["views"]), "", "100 %", _mib(found["memory"])]
    return columns([HEADINGS, *map(_cells, found["blocks"]), whole])


def _cells(block: dict[str, Any]) -> list[str]:
    by_place = sum(view["why"] == "place" for view in block["views"])
    counts = [f"{block['gaussians']:,}", f"{block['start']:,}", str(len(block["views"])), str(by_place)]
    return [block["name"], *counts, f"{100 * block['pairs']:.0f} %", _mib(block["memory"])]


def _mib(size: int) -> str:
    return f"{size / 2**20:,.0f}"

"""A partition, and the state of its runs, as tables in text."""

from typing import Any

from clsplat.errors import one_line
from clsplat.pages.columns import text_table
from clsplat.runs.expected import minutes_text
from clsplat.runs.status import status_text

HEADINGS = ("block", "owns", "starts from", "views", "of these by place", "pairs", "MiB at first")
GUESS = "memory and time are those of the beginning, up to the time with the most Gaussians; how many grow is a guess"
TIME = "time, by growth"


def table(found: dict[str, Any]) -> str:
    """Return a manifest as lines of text; MiB are those on the device at the beginning of a training.

    The time of a block goes from that of no growth to that of the most Gaussians.
    """
    whole = ["whole", *[f"{found['gaussians']:,}"] * 2, str(found["views"]), "", "100 %", _mib(found["memory"])]
    times = [one["seconds"] for one in found["blocks"] if "seconds" in one]
    if not times:
        return text_table([HEADINGS, *map(_cells, found["blocks"]), whole])
    rows = [[*_cells(block), minutes_text(seconds)] for block, seconds in zip(found["blocks"], times, strict=True)]
    low, high = (sum(ends) for ends in zip(*times, strict=True))
    total = [*whole, f"{minutes_text((low, high))}, one after the other"]
    return f"{text_table([[*HEADINGS, TIME], *rows, total])}\n{GUESS}"


def status_table(found: dict[str, Any]) -> str:
    """Return what `blocks_status` found as lines of text, a run a line."""
    done = sum(part["state"] == "done" for part in found["parts"])
    lines = [f"{found['in_blocks']}: {found['state']}, {done} of {len(found['parts'])} runs are done"]
    for part in found["parts"]:
        first = status_text(part).partition("\n")[0] if "run" in part else f"{part['name']}: {part['state']}"
        lines.append(f"{first}; {part['message']}" if part.get("message") else first)
    return "\n  ".join(map(one_line, lines))


def _cells(block: dict[str, Any]) -> list[str]:
    by_place = sum(view["why"] == "place" for view in block["views"])
    counts = [f"{block['gaussians']:,}", f"{block['start']:,}", str(len(block["views"])), str(by_place)]
    return [block["name"], *counts, f"{100 * block['pairs']:.0f} %", _mib(block["memory"])]


def _mib(size: int) -> str:
    return f"{size / 2**20:,.0f}"

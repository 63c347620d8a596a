"""Levels of detail as a table in text."""

from typing import Any

from clsplat.pages.columns import text_table

HEADINGS = ("level", "Gaussians", "MB", "PSNR, dB", "before training")


def table(found: dict[str, Any]) -> str:
    """Return what `levels_of_detail` returns as lines of text."""
    used = len(HEADINGS) if found["split"] else 3
    return text_table([HEADINGS[:used], *(_cells(level)[:used] for level in found["levels"])])


def _cells(level: dict[str, Any]) -> list[str]:
    size, psnr = f"{level['bytes'] / 1e6:.3g}", [level["psnr"], level["merged_psnr"]]
    return [str(level["level"]), f"{level['gaussians']:,}", size, *("" if db is None else f"{db:.2f}" for db in psnr)]

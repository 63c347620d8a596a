"""Collect the pages of the site in build/docs: the written ones from docs/, and the ones generated from the code."""

import shutil
from pathlib import Path

from families import ROOT
from other_pages import other_pages
from reference_pages import reference_pages

SUFFIXES = {".md", ".css", ".js", ".jpg", ".svg", ".html"}


def collect(out: Path) -> None:
    """Replace the folder `out` by the pages of the site."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for file in (ROOT / "docs").rglob("*"):
        if file.suffix in SUFFIXES:
            copy = out / file.relative_to(ROOT / "docs")
            copy.parent.mkdir(exist_ok=True)
            shutil.copyfile(file, copy)
    for path, text in (reference_pages() | other_pages()).items():
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        (out / path).write_text(text, "utf-8")


if __name__ == "__main__":
    collect(ROOT / "build" / "docs")

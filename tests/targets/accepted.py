"""Accepted faults: each is listed on the page, and one that no longer occurs is a failure."""

from collections.abc import Iterable

ACCEPTED = {
    "tgllp: blend_wide.cl (wide, PIXEL_BOX 1) does not compile: ocloc ended with -6": "no GPU uses *wide* by default",
    "pvc project_backward (PIXEL_BOX 1) spills registers (9)": "affects only the recipes `box` and `box_7k`",
    "pvc project_backward (PIXEL_BOX 1, TILE 16) spills registers (9)": "affects only the recipes `box` and `box_7k`",
    "pvc blend_backward (PIXEL_BOX 1, PIXEL_SUMS 13) spills registers (29)": "affects the box filter with texture sums",
    "pvc blend_backward (PIXEL_BOX 1, PIXEL_SUMS 13, TILE 16) spills registers (29)": "the same",
    **{
        f"pvc blend_forward (PIXEL_BOX 1{more}) spills registers (4)": "affects only the recipes `box` and `box_7k`"
        for more in ("", ", TILE 16", ", PIXEL_SUMS 13", ", PIXEL_SUMS 13, TILE 16")
    },
}


def unexpected_failures(failures: Iterable[str], everything: bool) -> list[str]:
    """Return the failures that are not accepted and, where `everything` was compiled, those that did not occur."""
    actual = list(failures)
    gone = [f"'{fault}' is accepted, and was not seen: remove it" for fault in ACCEPTED if fault not in actual]
    return [failure for failure in actual if failure not in ACCEPTED] + (gone if everything else [])


def text() -> str:
    """Return the accepted faults as Markdown."""
    return "Known faults:\n\n" + "\n".join(f"- {fault}: {whom}" for fault, whom in ACCEPTED.items())

"""What steps from photographs to cameras have left out, in sentences."""

import logging
from collections.abc import Mapping
from typing import Any

from clsplat.errors import amount, first_few
from clsplat.prepare.gather import remedy

LOG = logging.getLogger("clsplat")


def warn_of(figures: Mapping[str, Any]) -> None:
    """Log what a step has left out."""
    for text in left_out(figures):
        LOG.warning("%s", text)


def left_out(figures: Mapping[str, Any]) -> list[str]:
    """Return warnings of the photographs that a step has left out, by what it returned."""
    texts = []
    if damaged := figures.get("damaged"):
        names = [f"{name} ({reason})" for name, reason in damaged.items()]
        count = figures["photographs"] + len(names)
        texts.append(f"{len(names)} of {count} photographs cannot be read: {first_few(names)}; {remedy(damaged)}")
    if missing := figures.get("not_registered"):
        reasons = figures.get("reasons", {})
        named = first_few([f"{name} ({reasons[name]})" if name in reasons else name for name in missing])
        more = "" if figures.get("denser_tried") else ", or find more features (find_features.long_side)"
        texts.append(
            f"{len(missing)} of {figures['registered'] + len(missing)} photographs could not be placed: {named}; "
            f"the scene is made of the others: for more, add photographs from places between{more}"
        )
    if others := figures.get("other_models"):
        are = "is" if len(others) == 1 else "are"
        sizes = ", ".join([*map(str, others[:-1]), amount(others[-1], "photograph")])
        texts.append(
            f"{amount(len(others), 'smaller model')}, of {sizes}, {are} left out: add photographs that join "
            f"{'it' if len(others) == 1 else 'them'} to the largest"
        )
    return texts

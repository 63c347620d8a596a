"""The colours of the photographs in a run: where a training begins and ends, and where it is measured."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, NumericError, amount, quoted
from clsplat.core.files import VIEW_COLOURS, atomic, write_text
from clsplat.core.reading import read_json
from clsplat.core.settings import variants
from clsplat.photos.appearance import TABLE, Colours, OwnColours, ViewColours
from clsplat.photos.exposure_estimate import UNKNOWN, Exposures, measured, noted, with_noted
from clsplat.photos.photographs import Mask
from clsplat.scene.view import View
from clsplat.training.modules.exposure import Auto
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
KNOWN = "known exposures"  # in the numbers of a run: whether its colours began with exposures that were measured
GUESSED = 1.0  # dB by which figures in the photographs' colours are better, from which on the log says why


def photograph_colours(colours: Colours | None, run: Run, last: int) -> ViewColours | None:
    """Return the photographs' colours of a training whose last global step is given, or None where they have none.

    The numbers of a run that begins are set; a resumed run has them.
    """
    if isinstance(colours, Auto):
        colours = settled(colours, run).in_use
    if not isinstance(colours, OwnColours):
        return None
    views = [view.name for view in run.scene.split("train")]
    found = colours.of_views(views, run.device, run.colour_grids)
    tables = found.device_tables
    anew = tables is not None and tables is not run.colour_grids  # as those of the run are of other cells
    run.colour_grids = tables or run.colour_grids
    if anew or not found.begun(run.numbers):
        exposures = exposures_of(run)
        found.begin(run.numbers, exposures.log_gains)
        run.numbers[KNOWN] = float(bool(exposures.log_gains))
        LOG.info("colours of photographs: %s", exposures.text)
    return found.with_rate(colours.rate_of(last, len(set(views)), run.numbers.get(KNOWN, 1.0) > 0))


def exposures_of(run: Run) -> Exposures:
    """Return what the training photographs show of their exposures, or else what their cameras noted; measured once."""
    views = run.scene.split("train")
    names = tuple(view.name for view in views)
    if names not in run.exposures:

        def read(view: View) -> tuple[NDArray[np.uint8], Mask | None]:
            photograph = run.photographs.get(view)
            return photograph.image(), photograph.counted()

        counted = run.status.counted(views, "photographs", len(views))
        shown = measured(run.scene.tracks, counted, read) if run.scene.tracks else UNKNOWN
        told = len(shown.log_gains) == len(set(names))
        run.exposures[names] = shown if told else with_noted(shown, noted(views))
    return run.exposures[names]


def settled(colours: Auto, run: Run) -> Auto:
    """Return it with the choice that follows from the exposures of a run's photographs; one that is made stays."""
    if colours.chosen is not None:
        return colours
    exposures = exposures_of(run)
    if not exposures.log_gains:
        return colours.choose("off", exposures.text)
    few, alike = exposures.spread <= colours.above, exposures.explained <= colours.explained
    bounds = [f"{colours.above:.1%}", f"{colours.explained:.0%} of what differs"]
    if not few and not alike:
        return colours.choose("on", f"{exposures.text}; more than {bounds[0]}, and than {bounds[1]}")
    missed = " nor ".join(bound for bound, decides in zip(bounds, (few, alike), strict=True) if decides)
    return colours.choose("off", f"{exposures.text}; not more than {missed}")


def colours_of(run: Run) -> OwnColours | None:
    """Return what photographs have been given in training, or None."""
    if not any(name.startswith(f"{TABLE}/") for name in run.numbers):
        return None
    found = [getattr(stage, "colours", None) for stage in getattr(run.settings, "stages", ())]
    models = [one.in_use if isinstance(one, Auto) else one for one in found]
    columns = {name.split("/")[-1] for name in run.numbers if name.startswith(f"{TABLE}/")}
    begun = (one for one in reversed(models) if isinstance(one, OwnColours) and columns.issuperset(one.columns))
    return next(begun, None)


def write_view_colours(run: Run, colours: ViewColours | None) -> None:
    """Write the colours of each training photograph into the run folder; log a line.

    Raises NumericError for colours that are not finite.
    """
    if colours is None:
        return
    found = colours.written(run.numbers)
    if wrong := next((view for view, matrix in found.matrices.items() if not np.isfinite(matrix).all()), None):
        raise NumericError(f"the colours of {quoted(wrong)} are not finite; lower optimize.colours.rate")
    write_text(run.out / VIEW_COLOURS, json.dumps(found.facts, indent=1) + "\n")
    for name, array in found.arrays.items():
        with atomic(run.out / name) as file:
            np.save(file, array, allow_pickle=False)
    greens = [matrix[1, 1] for matrix in found.matrices.values()]
    LOG.info(
        "colours of %d photographs in %s: green is multiplied by %.2f to %.2f",
        *(len(greens), VIEW_COLOURS, min(greens), max(greens)),
    )


def colours_beside(model: Path) -> OwnColours | None:
    """Return what photographs were given where a model was trained, by the table beside its file; None without one.

    Raises DataError where the table is damaged.
    """
    path = model.with_name(VIEW_COLOURS)
    if not path.is_file():
        return None
    data, known = read_json(path, "colours of photographs"), variants(OwnColours)
    name = data.get("type") if isinstance(data, dict) else None
    if not isinstance(name, str) or name not in known:
        names = ", ".join(known)
        raise DataError(f"{path}: the type of colours is {quoted(name)}; expected one of {names}: write it again")
    return known[name]()


def tell_of_colours(averages: dict[str, Any]) -> None:
    """Log the figures of a split in the photographs' colours, where there are any."""
    if "psnr_colour" not in averages:
        return
    figure, reason = averages["psnr_colour"], averages.get("psnr_colour_reason")
    if figure is None:
        LOG.warning("no PSNR in the photographs' colours: %s", reason)
    elif reason:
        LOG.warning(
            "in the photographs' colours: PSNR %.2f dB, the mean of %s: %s",
            *(figure, amount(averages["psnr_colour_views"], "view"), reason),
        )
    else:
        differ = figure - averages["psnr"] > GUESSED
        why = "; exposures of these photographs differ, which PSNR counts as errors" if differ else ""
        LOG.info("in the photographs' colours: PSNR %.2f dB%s", figure, why)

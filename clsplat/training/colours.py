"""The colours of the photographs in a run: where a training begins and ends, and where it is measured."""

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, NumericError, quoted
from clsplat.files import atomic, write_text
from clsplat.names import VIEW_COLOURS, VIEW_GRIDS
from clsplat.reading import read_json
from clsplat.scene.view import View
from clsplat.settings import variants
from clsplat.training.run import Run
from clsplat.views.colours import IDENTITY, Auto, ColourModel, Colours, Floats, Grid, OwnColours
from clsplat.views.exposures import UNKNOWN, Exposures, measured, noted
from clsplat.views.photograph_colours import TABLE, PhotographColours, ViewColours
from clsplat.views.photograph_grids import GridTables, PhotographGrids, row_length
from clsplat.views.photographs import Mask

LOG = logging.getLogger("clsplat")
KNOWN = "known exposures"  # in the numbers of a run: whether its colours began with exposures that were measured
MEANING = "a colour c of the model, red, green and blue, is min(1, E c + b) in the photograph"
GRID_MEANING = (
    f"{MEANING}; [E | b] is the trilinear mean of the matrices about a pixel; file: matrices [photographs, luminance, "
    "height, width, 3, 4], float32, the outer ones on the edges of the image, at black and at white of 0.299 red + "
    "0.587 green + 0.114 blue; matrix: the mean of a photograph's"
)
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
    found = _of_views(colours, run, views)
    if not found.begun(run.numbers):
        exposures = exposures_of(run)
        found.begin(run.numbers, exposures.log_gains)
        run.numbers[KNOWN] = float(bool(exposures.log_gains))
        LOG.info("colours of photographs: %s", exposures.text)
    rate = colours.rate_of(last, len(set(views)), run.numbers.get(KNOWN, 1.0) > 0)
    return replace(found, rate=rate)


def _of_views(colours: OwnColours, run: Run, views: list[str]) -> PhotographColours | PhotographGrids:
    """The colours of these views, with the tables of a run where they have such."""
    if isinstance(colours, ColourModel):
        return PhotographColours(colours, views, 0.0)
    if not isinstance(colours, Grid):
        raise TypeError(f"{type(colours).__name__}: expected a ColourModel or a Grid")
    shape = len(set(views)), row_length(colours.cells)
    if run.grids is None or run.grids.shape != shape:  # grids of another size begin anew
        run.grids = GridTables(run.device, shape)
        run.numbers = {name: value for name, value in run.numbers.items() if not name.endswith("/row")}
    return PhotographGrids(colours, views, 0.0, run.grids)


def exposures_of(run: Run) -> Exposures:
    """Return what the training photographs show of their exposures, or else what cameras noted; measured once."""
    views = run.scene.split("train")
    names = tuple(view.name for view in views)
    if names not in run.exposures:

        def read(view: View) -> tuple[NDArray[np.uint8], Mask | None]:
            photograph = run.photographs.get(view)
            return photograph.image(), photograph.counted()

        counted = run.status.counted(views, "photographs", len(views))
        shown = measured(run.scene.tracks, counted, read) if run.scene.tracks else UNKNOWN
        run.exposures[names] = shown if shown.log_gains else noted(views)
    return run.exposures[names]


def settled(colours: Auto, run: Run) -> Auto:
    """Return it with the choice that follows from the exposures of a run's photographs; one that is made stays."""
    if colours.chosen is not None:
        return colours
    exposures = exposures_of(run)
    if not exposures.log_gains:
        return colours.choose("off", exposures.text)
    differ = exposures.spread > colours.above and exposures.explained > colours.explained
    bounds = f"more than {colours.above:.1%} and {colours.explained:.0%}"
    return colours.choose("on" if differ else "off", f"{exposures.text}; {'' if differ else 'not '}{bounds}")


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
    """Write the colours of each training photograph into the run folder; log a line."""
    if isinstance(colours, PhotographColours):
        _write_matrices(run, colours)
    elif isinstance(colours, PhotographGrids):
        _write_grids(run, colours)


def _write_matrices(run: Run, colours: PhotographColours) -> None:
    """The numbers of each photograph, and the matrix that they make."""
    rows = {view: colours.table.row(run.numbers, view) for view in colours.table.views}
    matrices = {view: colours.model.matrix(row) for view, row in rows.items()}
    photographs = {
        view: {
            **dict(zip(colours.model.columns, map(float, row), strict=True)),
            "matrix": matrices[view].tolist(),
        }
        for view, row in rows.items()
    }
    meaning = f"{MEANING}; matrix: the rows of [E | b]"
    _write(run, colours.model, matrices, {"meaning": meaning, "photographs": photographs})


def _write_grids(run: Run, colours: PhotographGrids) -> None:
    """The grids in a file of NumPy's, and the row of each photograph in it."""
    (nx, ny, nz), values = colours.model.cells, colours.tables.tables(["values"])["values"]
    grids = values.reshape(-1, 3, 4, nz, ny, nx).transpose(0, 3, 4, 5, 1, 2) + IDENTITY.astype(np.float32)
    names = list(dict.fromkeys(colours.views))
    mean = {view: grid.mean(axis=(0, 1, 2), dtype=np.float64) for view, grid in zip(names, grids, strict=True)}
    facts = {
        "meaning": GRID_MEANING,
        "cells": [nx, ny, nz],
        "file": VIEW_GRIDS,
        "photographs": {view: {"row": row, "matrix": mean[view].tolist()} for row, view in enumerate(names)},
    }
    _write(run, colours.model, mean, facts)
    with atomic(run.out / VIEW_GRIDS) as file:
        np.save(file, np.ascontiguousarray(grids, np.float32), allow_pickle=False)


def _write(run: Run, model: OwnColours, matrices: dict[str, Floats], facts: dict[str, Any]) -> None:
    """Write facts as JSON, and log a line.  Raises NumericError for matrices that are not finite."""
    if wrong := next((view for view, matrix in matrices.items() if not np.isfinite(matrix).all()), None):
        raise NumericError(f"the colours of {quoted(wrong)} are not finite; lower optimize.colours.rate")
    data = {"meaning": facts.pop("meaning"), "type": getattr(model, "type", type(model).__name__), **facts}
    write_text(run.out / VIEW_COLOURS, json.dumps(data, indent=1) + "\n")
    greens = [matrix[1, 1] for matrix in matrices.values()]
    LOG.info(
        "colours of %d photographs in %s: green is multiplied by %.2f to %.2f",
        *(len(matrices), VIEW_COLOURS, min(greens), max(greens)),
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
    differ = averages["psnr_colour"] - averages["psnr"] > GUESSED
    why = "; exposures of these photographs differ, which PSNR counts as errors" if differ else ""
    LOG.info("in the photographs' colours: PSNR %.2f dB%s", averages["psnr_colour"], why)

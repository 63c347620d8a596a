"""The colours of the photographs at the beginning of a training."""

from clsplat.training.run import Run
from clsplat.views.colours import ColourModel, Colours
from clsplat.views.photograph_colours import PhotographColours


def photograph_colours(colours: Colours | None, run: Run, last: int) -> PhotographColours | None:
    """Return the photographs' colours of a training whose last global step is given, or None where they have none.

    The numbers of a run that begins are set; a resumed run has them.
    """
    if not isinstance(colours, ColourModel):
        return None
    views = [view.name for view in run.scene.split("train")]
    found = PhotographColours(colours, views, colours.rate_of(last, len(set(views))))
    if not found.table.begun(run.numbers):
        found.begin(run.numbers, {})
    return found

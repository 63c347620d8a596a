"""The tables of the best model of a run: copied to the host, and put back."""

from clsplat.gaussians.tables import Gaussians
from clsplat.render.backdrops import Auto, Directions
from clsplat.training import colour_grids, sky
from clsplat.training.archive import split
from clsplat.training.kept import Tables, tables_of
from clsplat.training.run import Run
from clsplat.training.sky import LearnedSky


def copied_of(run: Run) -> Tables:
    """Copy what the run's model needs to be rendered, and to be trained from anew, to the host."""
    own = run.sky.tables() if run.sky else {}
    behind = {sky.FOLDER + name: table for name, table in own.items()}
    of_colours = run.colour_grids.tables(["values"]) if run.colour_grids else {}
    photographs = {colour_grids.FOLDER + name: table for name, table in of_colours.items()}
    return {**tables_of(run.model), **behind, **photographs}


def put_back(run: Run, tables: Tables, degree: int) -> None:
    """Make what was copied the run's model."""
    own, of_gaussians = split(tables, sky.FOLDER)
    of_colours, of_gaussians = split(of_gaussians, colour_grids.FOLDER)
    if of_colours and run.colour_grids:
        run.colour_grids.set(of_colours)
    run.model = run.model_settings.model(Gaussians(run.device, of_gaussians), degree)
    restore_sky(run, own)


def restore_sky(run: Run, tables: Tables) -> None:
    """Give a run the sky of its tables, by their own names; without any it has none."""
    given = run.model_settings.background
    background = given.model if isinstance(given, Auto) else given
    run.sky = None
    if tables and isinstance(background, Directions):
        run.sky = LearnedSky.of_tables(background, tables, run.device)

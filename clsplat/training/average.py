"""The average of the parameters over steps, in tables beside them (Polyak and Juditsky 1992)."""

from clsplat.gaussians.tables import Gaussians

FOLDER = "average/"  # before the names of the parameters
NUMBER = f"{FOLDER}number"  # [1] of steps in the average of a row


def attach(gaussians: Gaussians) -> None:
    """Add the tables, unless they are there: no step so far.  Rows of new Gaussians begin anew."""
    if NUMBER not in gaussians.tables:
        for name in gaussians.trained:
            gaussians.add(FOLDER + name, gaussians.tables[name].components, zero_fresh=True)
        gaussians.add(NUMBER, 1, zero_fresh=True)


def add(gaussians: Gaussians) -> None:
    """Add the present parameters to their averages."""
    program, count = gaussians.device.program("average.cl"), gaussians.count
    for name in gaussians.trained:
        program.add_to_average(
            items=(count, gaussians.tables[name].components),
            values=gaussians[name],
            average=gaussians[FOLDER + name],
            number=gaussians[NUMBER],
            stride=gaussians.capacity,
            count=count,
        )
    program.count_step(items=count, number=gaussians[NUMBER], count=count)


def take(gaussians: Gaussians) -> None:
    """Replace the parameters by their averages, those of rows without one stay, and remove the tables."""
    program = gaussians.device.program("average.cl")
    for name in gaussians.trained:
        program.take_average(
            items=(gaussians.count, gaussians.tables[name].components),
            values=gaussians[name],
            average=gaussians[FOLDER + name],
            number=gaussians[NUMBER],
            stride=gaussians.capacity,
            count=gaussians.count,
        )
    for table in (NUMBER, *(FOLDER + name for name in gaussians.trained)):
        del gaussians.tables[table]

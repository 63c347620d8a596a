"""Which parameters of Gaussians are numbers."""

import numpy as np

from clsplat.gaussians.moments import moment_tables
from clsplat.gaussians.struct import Struct


def not_finite(gaussians: Struct) -> list[str]:
    """Return the names of the parameters that hold NaN or infinity, or whose moments do."""
    device, found = gaussians.device, set()
    counters = {name: device.zeros(1, np.uint32) for name in gaussians.trained}
    for name, counter in counters.items():
        for table in gaussians.tables.keys() & {name, *moment_tables(name)}:
            if gaussians.on_host and table in gaussians.on_host:
                found |= set() if np.isfinite(gaussians.get(table)).all() else {name}
                continue
            device.program("check.cl").count_not_finite(
                items=(gaussians.count, gaussians.tables[table].components),
                values=gaussians[table],
                counter=counter,
                stride=gaussians.capacity,
                count=gaussians.count,
            )
    return [name for name, counter in counters.items() if name in found or counter.get_item(0) > 0]

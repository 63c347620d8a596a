"""Offer the devices of this machine to a scheduler: what `clsplat worker` does."""

import logging
from collections.abc import Sequence

from clsplat.core.machine import Owner
from clsplat.pipeline.execution import Execution
from clsplat.sweeps.connection import require_certificates
from clsplat.sweeps.devices import places

LOG = logging.getLogger("clsplat")


def offer(execution: Execution, devices: Sequence[str] | None = None) -> None:
    """Prove each device by a short run, and work for a scheduler until it ends or a signal comes.

    execution: its engine is the scheduler; devices: names, default every device that works.  Raises DeviceError where
    there is none or no scheduler answers.
    """
    from clsplat.sweeps import dask  # where Dask is installed

    if execution.tls:
        require_certificates(execution.tls)  # before a device is proved, which takes a while
    found = places(Owner.this().host, list(devices) if devices is not None else None)
    for place in found:
        LOG.info("offers %s, bits:%s", place.text, place.bits)
    dask.serve(execution, found)

"""Workers of a Dask scheduler: the other side of `scheduler`."""

import asyncio
import json
import logging
import threading
from collections.abc import Sequence
from typing import Any

from clsplat.cluster.execution import Execution
from clsplat.cluster.fingerprint import code_digest
from clsplat.cluster.probe import Place
from clsplat.cluster.scheduler import (
    ANSWER,
    LOOPBACK,
    SETTINGS,
    dask,
    distributed,
    security,
    unanswered,
    warn_of_open_port,
)
from clsplat.errors import Interrupted
from clsplat.signals import stopping_on_signals


def serve(execution: Execution, found: Sequence[Place]) -> None:
    """Let a process a device work for a scheduler, until that ends or a signal comes.  Raises DeviceError."""
    warn_of_open_port(execution)
    stop = threading.Event()
    with dask.config.set(SETTINGS), stopping_on_signals(stop.set):
        asyncio.run(_serve(execution, found, stop))
    if stop.is_set():
        raise Interrupted("stopped; cells that ran here go on elsewhere")


async def _serve(execution: Execution, found: Sequence[Place], stop: threading.Event) -> None:
    options: dict[str, Any] = {"nthreads": 1, "memory_limit": 0, "security": security(execution.tls)}
    if execution.is_local:
        options["host"] = LOOPBACK
    nannies = [
        distributed.Nanny(
            execution.address,
            name=json.dumps({"host": place.worker, "device": place.device, "bits": place.bits, "code": code_digest()}),
            dashboard_address=f"{LOOPBACK}:0",
            silence_logs=logging.CRITICAL,
            **options,
        )
        for place in found
    ]
    try:
        await asyncio.wait_for(asyncio.gather(*nannies), ANSWER)
    except (OSError, TimeoutError, RuntimeError) as error:
        raise unanswered(execution, error) from None
    while not stop.is_set() and any(nanny.status is distributed.Status.running for nanny in nannies):
        await asyncio.sleep(0.2)
    await asyncio.gather(*(nanny.close(timeout=5) for nanny in nannies))

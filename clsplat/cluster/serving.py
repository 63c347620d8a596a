"""Worker processes of this machine, one a device, for a scheduler elsewhere."""

import asyncio
import json
import logging
import threading
from collections.abc import Sequence
from functools import partial

from clsplat.cluster.connection import unanswered, warn_of_open_port
from clsplat.cluster.fingerprint import code_digest
from clsplat.cluster.library import LOOPBACK, SETTINGS, dask, distributed, security
from clsplat.cluster.probe import TOLD, Place
from clsplat.errors import Interrupted
from clsplat.pipeline.execution import Execution
from clsplat.signals import stopping_on_signals

ANSWER = 20.0  # seconds that a scheduler may take to answer


def serve(execution: Execution, found: Sequence[Place]) -> None:
    """Let a process a device work for a scheduler, until that ends or a signal comes.  Raises DeviceError."""
    warn_of_open_port(execution)
    stop = threading.Event()
    with dask.config.set(SETTINGS), stopping_on_signals(stop.set):
        asyncio.run(_serve(execution, found, stop))
    if stop.is_set():
        raise Interrupted("stopped; cells that ran here go on elsewhere")


def _told(text: str, worker: object) -> str:
    """What a worker says of itself among its figures."""
    return text


async def _serve(execution: Execution, found: Sequence[Place], stop: threading.Event) -> None:
    told = [
        {
            "host": place.worker,
            "device": place.device,
            "bits": place.bits,
            "limits": [place.memory, place.allocation],
            "unified": place.unified,
            "code": code_digest(),
        }
        for place in found
    ]
    nannies = [
        distributed.Nanny(
            execution.address,
            nthreads=1,
            memory_limit=0,
            security=security(execution.tls),
            host=LOOPBACK if execution.is_local else None,
            metrics={TOLD: partial(_told, json.dumps(one))},
            dashboard_address=f"{LOOPBACK}:0",
            silence_logs=logging.CRITICAL,
        )
        for one in told
    ]
    try:
        await asyncio.wait_for(asyncio.gather(*nannies), ANSWER)
    except (OSError, TimeoutError, RuntimeError) as error:
        raise unanswered(execution, error) from None
    while not stop.is_set() and any(nanny.status is distributed.Status.running for nanny in nannies):
        await asyncio.sleep(0.2)
    await asyncio.gather(*(nanny.close(timeout=5) for nanny in nannies))

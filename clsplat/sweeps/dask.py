"""Engines on Dask: a cluster of this machine, or a scheduler elsewhere.

Dask gives membership, liveness and a queue.  What it does not give is in the store: going on inside of a cell, once in
effect, stopping.  At most one cell a device is in flight, for a worker that dies takes all cells on its list with it.
"""

import asyncio
import json
import logging
import ssl
import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError, DataError, DeviceError, InternalError, Interrupted, one_line
from clsplat.core.machine import Owner
from clsplat.core.reading import read_file
from clsplat.core.signals import stopping_on_signals
from clsplat.pipeline.execution import Execution, Tls
from clsplat.sweeps.cell import CellRun, code_digest
from clsplat.sweeps.child import PATIENCE, plugin_files, run_command
from clsplat.sweeps.devices import TOLD, DeviceSlot, place_of, places
from clsplat.sweeps.engines import ALONE, CellLost, Ticket
from clsplat.sweeps.store import Store
from clsplat.sweeps.task import Outcome, Terms, run_cell

# Dask, where it is installed, and how it is set.  Nothing else imports it.

try:
    import dask
    import distributed
except ImportError:
    raise ConfigError("this engine needs Dask: pip install 'clsplat[cluster]'") from None

__all__ = ["LOOPBACK", "SETTINGS", "dask", "distributed", "security"]
LOOPBACK = "127.0.0.1"
SIDES = ("client", "worker", "scheduler")
SETTINGS = {
    "distributed.scheduler.allowed-failures": 1000,  # attempts are counted in the store
    "distributed.scheduler.worker-ttl": "60s",  # of one that is frozen: its cell goes on elsewhere
    "distributed.worker.preload": ["clsplat.sweeps.preload"],
    "distributed.worker.memory.target": False,  # of a worker's share of memory, which its child does not take from
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.comm.timeouts.connect": "60s",
}


def require_certificates(tls: Tls) -> None:
    """Raise ConfigError where one cannot be read, or they do not belong together.  Dask would name no file."""
    for key in ("ca", "cert", "key"):
        try:
            read_file(Path(getattr(tls, key)))
        except DataError as error:
            raise ConfigError(f"tls.{key} (--tls-{key}): {error}") from error
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(tls.ca)
    except ssl.SSLError as error:
        raise ConfigError(f"tls.ca (--tls-ca): {tls.ca}: expected a certificate in PEM ({error.reason})") from error
    try:
        context.load_cert_chain(tls.cert, tls.key, password=lambda: "")  # else it would ask in the terminal
    except (ssl.SSLError, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        raise ConfigError(
            f"tls.cert, tls.key (--tls-cert, --tls-key): {tls.cert}, {tls.key}: expected a certificate in PEM and its "
            f"private key, without a password ({reason})"
        ) from error


def security(tls: Tls | None) -> Any:
    """Return the certificates as distributed takes them; None without.  Raises ConfigError."""
    if tls is None:
        return None
    require_certificates(tls)
    sides = {f"tls_{side}_{part}": getattr(tls, part) for side in SIDES for part in ("cert", "key")}
    return distributed.Security(tls_ca_file=tls.ca, require_encryption=True, **sides)


def warn_of_open_port(execution: Execution) -> None:
    """Say so where a scheduler elsewhere is reached without TLS."""
    if execution.insecure:
        LOG.warning("%s: is not encrypted; whoever reaches the scheduler's port can run code", execution.engine)


def unanswered(execution: Execution, error: BaseException) -> DeviceError:
    """Return the error of a scheduler that cannot be reached."""
    reason = one_line(error.__cause__ or error) or "no answer"
    remedy = "start it with `dask scheduler`"
    if execution.tls:
        remedy += " and certificates of the authority that tls.ca (--tls-ca) names"
    return DeviceError(f"{execution.engine}: cannot be worked with ({reason}); {remedy}")


LOG = logging.getLogger("clsplat")
LOOK = 5.0  # seconds between two looks at the workers
ANSWER = 20.0  # seconds that a scheduler may take to answer


def work(cell: str, store: str, command: list[str], terms: str) -> str:
    """Run a cell on a worker: text in, text out."""
    outcome = run_cell(CellRun.from_json(cell), Store(Path(store)), command, Terms(**json.loads(terms)))
    return json.dumps(asdict(outcome))


def engine(execution: Execution, store: Store, devices: list[str] | None) -> "Cluster":
    """Return the engine that `execution` names.  Raises DeviceError where there are no devices."""
    with ExitStack() as held:
        held.enter_context(dask.config.set(SETTINGS))  # until the engine is closed
        cluster = _engine(execution, store, devices)
        cluster.settings = held.pop_all()
        return cluster


def _engine(execution: Execution, store: Store, devices: list[str] | None) -> "Cluster":
    if execution.engine == "local":
        found = places("local", devices, execution.packing)
        cluster = distributed.LocalCluster(
            n_workers=len(found),
            threads_per_worker=1,
            processes=True,
            host=LOOPBACK,
            dashboard_address=f"{LOOPBACK}:0",
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        )
        return Cluster(distributed.Client(cluster, set_as_default=False), store, cluster, found)
    warn_of_open_port(execution)
    try:
        client = distributed.Client(
            execution.address, security=security(execution.tls), set_as_default=False, timeout=ANSWER
        )
    except OSError as error:
        raise unanswered(execution, error) from None
    return Cluster(client, store)


class _Future:
    def __init__(self, cluster: "Cluster", future: Any, address: str | None) -> None:
        self._cluster, self.future, self._address = cluster, future, address
        self.is_over = False  # a future that was released has no state

    def outcome(self) -> Outcome | None:
        state = self.future.status
        if state == "pending":
            if self._address and self._address not in self._cluster.addresses:
                self.is_over = True
                self.future.cancel()
                raise CellLost
            return None
        if state == "finished":
            outcome = Outcome(**json.loads(self.future.result()))
            self.is_over = True
            self.future.release()
            return outcome
        if state == "error" and not isinstance(error := self.future.exception(), distributed.KilledWorker):
            raise InternalError(f"internal error (a bug) in a worker: {type(error).__name__}: {error}")
        raise CellLost


class Cluster:
    """The devices of a Dask cluster."""

    def __init__(self, client: Any, store: Store, cluster: Any = None, found: list[DeviceSlot] | None = None) -> None:
        """cluster: what starts workers of this machine, and starts them again; found: its devices, on any of which they
        run cells.  Of a scheduler elsewhere both are None, and each worker has its own device.
        """
        self._client, self._store, self._cluster, self._found = client, store, cluster, found
        self._sweep = uuid.uuid4().hex
        self._looked, self._seen = -LOOK, time.monotonic()
        self._places: list[DeviceSlot] = []
        self._tickets: list[_Future] = []
        self.addresses: set[str] = set()
        self.settings = ExitStack()  # of Dask, which end with the cluster
        self.command_of = lambda device: run_command(device, plugin_files())

    def places(self) -> list[DeviceSlot]:
        """Return the devices whose workers live.

        Raises DeviceError where the scheduler ended, or no worker of this version was there for a minute.
        """
        now = time.monotonic()
        if now - self._looked >= LOOK or (not self._places and now - self._looked >= 0.5):
            self._looked = now
            self._look(now)
        return self._places

    def _look(self, now: float) -> None:
        with self._needs_scheduler():
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
        self.addresses = set(workers)
        if self._cluster and len(workers) < (count := len(self._found or ())):
            self._cluster.scale(count)  # a worker that dies while it starts is not started again by itself
        known = [one for address, worker in workers.items() if (one := place_of(address, worker))]
        self._places = known if self._found is None else self._found if workers else []
        if self._places:
            self._seen = now
        elif now - self._seen > ALONE:
            others = f" ({len(workers)} of another version get no cells)" if workers else ""
            raise DeviceError(
                f"no worker of this version for {ALONE:.0f} s{others}; start some with `clsplat worker --scheduler "
                "ADDRESS`; what was done is in the store"
            )

    @contextmanager
    def _needs_scheduler(self) -> Iterator[None]:
        """Raise DeviceError where the block fails, for the scheduler is gone: its client has given up."""
        try:
            yield
        except Exception as error:  # of which type depends on the moment
            if isinstance(error, OSError) or self._client.status in ("closing", "closed"):
                raise DeviceError("the scheduler ended; start it, and run the sweep again with --resume") from error
            raise

    def start(self, cell: CellRun, place: DeviceSlot, terms: Terms) -> Ticket:
        own = replace(terms, worker=place.worker, sweep=self._sweep, cores=place.cores)
        address = place.worker if self._found is None else None
        with self._needs_scheduler():
            future = self._client.submit(
                work,
                cell.json(),
                str(self._store.root),
                list(self.command_of(place.device)),
                json.dumps(asdict(own)),
                key=f"{cell.name}-{uuid.uuid4().hex[:8]}",
                workers=[address] if address else None,
                pure=False,
            )
        ticket = _Future(self, future, address)
        self._tickets = [*(one for one in self._tickets if not one.is_over), ticket]
        return ticket

    def close(self) -> None:
        """Let the cells that run save their state and end, then the workers of this machine."""
        if self._pending:
            self._store.stop(self._sweep)
        end = time.monotonic() + PATIENCE
        while self._pending and time.monotonic() < end:
            time.sleep(0.1)
        if self._pending:
            LOG.warning("some cells did not end in %.0f s", PATIENCE)
        with self.settings:
            self._client.close()
            if self._cluster:
                self._cluster.close()

    @property
    def _pending(self) -> "list[_Future]":
        return [one for one in self._tickets if not one.is_over and one.future.status == "pending"]


# Worker processes of this machine, one a device, for a scheduler elsewhere.


def offer(execution: Execution, devices: Sequence[str] | None = None) -> None:
    """Prove each device by a short run, and work for a scheduler until it ends or a signal comes: `clsplat worker`.

    execution: its engine is the scheduler; devices: names, default every device that works.  Raises DeviceError where
    there is none or no scheduler answers.
    """
    if execution.tls:
        require_certificates(execution.tls)  # before a device is proved, which takes a while
    found = places(Owner.current().host, list(devices) if devices is not None else None)
    for place in found:
        LOG.info("offers %s, bits:%s", place.text, place.bits)
    warn_of_open_port(execution)
    stop = threading.Event()
    with dask.config.set(SETTINGS), stopping_on_signals(stop.set):
        asyncio.run(_serve(execution, found, stop))
    if stop.is_set():
        raise Interrupted("stopped; cells that ran here go on elsewhere")


def _told(text: str, worker: object) -> str:
    """What a worker says of itself among its figures."""
    return text


async def _serve(execution: Execution, found: Sequence[DeviceSlot], stop: threading.Event) -> None:
    told = [
        {
            "host": place.worker,
            "device": place.device,
            "bits": place.bits,
            "memory": place.memory,
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

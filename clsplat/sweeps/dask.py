"""Run cells with Dask: on a cluster of this machine, or through a scheduler elsewhere.

Dask keeps track of workers and provides a queue.  The store makes it possible to resume and stop cells, and accepts one
result per cell.  Each device has at most one cell at a time, because a worker that crashes loses its entire queue.
"""

import asyncio
import json
import logging
import os
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
from clsplat.sweeps.child import STOP_TIMEOUT_S, plugin_files, run_command
from clsplat.sweeps.devices import METRIC_KEY, DeviceSlot, find_slots, slot_from_worker
from clsplat.sweeps.engines import NO_DEVICE_TIMEOUT_S, CellLost, Ticket
from clsplat.sweeps.store import Store
from clsplat.sweeps.task import CellOptions, Outcome, run_cell

# Dask and its settings.  No other module imports Dask.

try:
    import dask
    import distributed
except ImportError:
    raise ConfigError("this engine needs Dask; in a checkout, run `pip install '.[cluster]'`") from None

__all__ = ["LOOPBACK", "SETTINGS", "dask", "distributed", "make_security"]
LOOPBACK = "127.0.0.1"
SIDES = ("client", "worker", "scheduler")
SETTINGS = {
    "distributed.scheduler.allowed-failures": 1000,  # attempts are counted in the store
    "distributed.scheduler.worker-ttl": "60s",  # after this, a frozen worker is dropped; its cell continues elsewhere
    "distributed.worker.preload": ["clsplat.sweeps.preload"],
    "distributed.worker.memory.target": False,  # these limits do not apply to the child process that runs the cell
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.comm.timeouts.connect": "60s",
}


def require_certificates(tls: Tls) -> None:
    """Raise ConfigError if a file of `tls` cannot be read, or if its private key does not match its certificate."""
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
        context.load_cert_chain(tls.cert, tls.key, password=lambda: "")  # else OpenSSL asks for it in the terminal
    except (ssl.SSLError, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        raise ConfigError(
            f"tls.cert, tls.key (--tls-cert, --tls-key): {tls.cert}, {tls.key}: expected a certificate in PEM and its "
            f"private key, without a password ({reason})"
        ) from error


def make_security(tls: Tls | None) -> Any:
    """Return the `distributed.Security` with the certificates of `tls`; None without TLS.  Raises ConfigError."""
    if tls is None:
        return None
    require_certificates(tls)
    sides = {f"tls_{side}_{item}": getattr(tls, item) for side in SIDES for item in ("cert", "key")}
    return distributed.Security(tls_ca_file=tls.ca, require_encryption=True, **sides)


def warn_about_open_port(execution: Execution) -> None:
    """Warn if a remote scheduler is used without TLS."""
    if execution.insecure:
        LOG.warning("%s: not encrypted; anyone who can reach the scheduler's port can run code", execution.engine)


def scheduler_error(execution: Execution, error: BaseException) -> DeviceError:
    """Return the error for an unreachable scheduler, with the reason and a remedy."""
    reason = one_line(error.__cause__ or error) or "no answer"
    remedy = "start it with `dask scheduler`"
    if execution.tls:
        remedy += " and certificates of the authority that tls.ca (--tls-ca) names"
    return DeviceError(f"{execution.engine}: cannot be reached ({reason}); {remedy}")


LOG = logging.getLogger("clsplat")
WORKERS_INTERVAL_S = 5.0  # time between two checks of the workers
CONNECT_TIMEOUT_S = 20.0  # maximum time for connecting to a scheduler


def run_cell_on_worker(cell: str, store: str, command: list[str], options: str) -> str:
    """Run a cell on a worker; return its `Outcome` as JSON.  cell, options: as JSON."""
    outcome = run_cell(CellRun.from_json(cell), Store(Path(store)), command, CellOptions(**json.loads(options)))
    return json.dumps(asdict(outcome))


def open_engine(execution: Execution, store: Store, devices: list[str] | None) -> "Cluster":
    """Return the engine for `execution`.  Raises DeviceError if there are no devices."""
    os.environ["PYTHONSAFEPATH"] = "1"  # like -P, so that workers import nothing from the working folder
    with ExitStack() as settings:
        settings.enter_context(dask.config.set(SETTINGS))  # until the engine is closed
        cluster = _connect(execution, store, devices)
        cluster.settings = settings.pop_all()
        return cluster


def _connect(execution: Execution, store: Store, devices: list[str] | None) -> "Cluster":
    if execution.engine == "local":
        slots = find_slots("local", devices, execution.packing)
        cluster = distributed.LocalCluster(
            n_workers=len(slots),
            threads_per_worker=1,
            processes=True,
            host=LOOPBACK,
            dashboard_address=f"{LOOPBACK}:0",
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        )
        return Cluster(distributed.Client(cluster, set_as_default=False), store, cluster, slots)
    warn_about_open_port(execution)
    try:
        client = distributed.Client(
            execution.address, security=make_security(execution.tls), set_as_default=False, timeout=CONNECT_TIMEOUT_S
        )
    except OSError as error:
        raise scheduler_error(execution, error) from None
    return Cluster(client, store)


class _Future:
    def __init__(self, cluster: "Cluster", future: Any, address: str | None) -> None:
        self._cluster, self.future, self._address = cluster, future, address
        self.is_over = False  # recorded here, because a released future has no state

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

    def __init__(
        self, client: Any, store: Store, cluster: Any = None, local_slots: list[DeviceSlot] | None = None
    ) -> None:
        """client: the Dask client.  cluster: starts and restarts local workers.  local_slots: the local devices.

        Any local worker can use any local device.  With a remote scheduler, `cluster` and `local_slots` are None, and
        each worker has one device.
        """
        self._client, self._store, self._cluster, self._local_slots = client, store, cluster, local_slots
        self._sweep = uuid.uuid4().hex
        self._last_check, self._last_worker = -WORKERS_INTERVAL_S, time.monotonic()
        self._slots: list[DeviceSlot] = []
        self._tickets: list[_Future] = []
        self.addresses: set[str] = set()
        self.settings = ExitStack()  # Dask settings, restored when the cluster is closed
        self.make_command = lambda device: run_command(device, plugin_files())

    def slots(self) -> list[DeviceSlot]:
        """Return the devices of live workers.

        Raises DeviceError if the scheduler has exited, or if there has been no worker of this version for a minute.
        """
        now = time.monotonic()
        if now - self._last_check >= WORKERS_INTERVAL_S or (not self._slots and now - self._last_check >= 0.5):
            self._last_check = now
            self._update_slots(now)
        return self._slots

    def _update_slots(self, now: float) -> None:
        with self._requires_scheduler():
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
        self.addresses = set(workers)
        if self._cluster and len(workers) < (count := len(self._local_slots or ())):
            self._cluster.scale(count)  # Dask does not restart a worker that dies while it starts
        remote_slots = [slot for address, worker in workers.items() if (slot := slot_from_worker(address, worker))]
        self._slots = remote_slots if self._local_slots is None else self._local_slots if workers else []
        if self._slots:
            self._last_worker = now
        elif now - self._last_worker > NO_DEVICE_TIMEOUT_S:
            hint = f" ({len(workers)} of another version get no cells)" if workers else ""
            raise DeviceError(
                f"for {NO_DEVICE_TIMEOUT_S:.0f} s, no worker of this version has been connected{hint}; start some with "
                "`clsplat worker --scheduler ADDRESS`; the store keeps all progress"
            )

    @contextmanager
    def _requires_scheduler(self) -> Iterator[None]:
        """Raise DeviceError if the block fails because the scheduler has exited."""
        try:
            yield
        except Exception as error:  # its type depends on when the scheduler ended
            if isinstance(error, OSError) or self._client.status in ("closing", "closed"):
                raise DeviceError("the scheduler exited; restart it, and run the sweep again with --resume") from error
            raise

    def start(self, cell: CellRun, slot: DeviceSlot, options: CellOptions) -> Ticket:
        slot_options = replace(options, worker=slot.worker, sweep=self._sweep, cores=slot.cores)
        worker_address = slot.worker if self._local_slots is None else None
        with self._requires_scheduler():
            future = self._client.submit(
                run_cell_on_worker,
                cell.json(),
                str(self._store.root),
                list(self.make_command(slot.device)),
                json.dumps(asdict(slot_options)),
                key=f"{cell.name}-{uuid.uuid4().hex[:8]}",
                workers=[worker_address] if worker_address else None,
                pure=False,
            )
        ticket = _Future(self, future, worker_address)
        self._tickets = [*(old_ticket for old_ticket in self._tickets if not old_ticket.is_over), ticket]
        return ticket

    def close(self) -> None:
        """Let running cells save their state and stop; then close the client and the local workers."""
        if self._pending:
            self._store.stop(self._sweep)
        deadline = time.monotonic() + STOP_TIMEOUT_S
        while self._pending and time.monotonic() < deadline:
            time.sleep(0.1)
        if self._pending:
            LOG.warning(
                "some cells did not stop within %.0f s; run the same command with --resume to continue them from their "
                "last checkpoints",
                STOP_TIMEOUT_S,
            )
        with self.settings:
            self._client.close()
            if self._cluster:
                self._cluster.close()

    @property
    def _pending(self) -> "list[_Future]":
        return [ticket for ticket in self._tickets if not ticket.is_over and ticket.future.status == "pending"]


# Worker processes of this machine, one per device, for a remote scheduler.


def offer_devices(execution: Execution, devices: Sequence[str] | None = None) -> None:
    """Test each device with a short run, and run cells of a scheduler until it exits or a signal arrives.

    This is `clsplat worker`.  execution: contains the address of the scheduler.  devices: names of devices; default:
    all working devices.  Raises DeviceError if there is no device, or if the scheduler does not respond.
    """
    if execution.tls:
        require_certificates(execution.tls)  # before the devices are tested, which takes a while
    slots = find_slots(Owner.current().host, list(devices) if devices is not None else None)
    for slot in slots:
        LOG.info("offering %s, bits class %s", slot.text, slot.bits)
    warn_about_open_port(execution)
    stop = threading.Event()
    with dask.config.set(SETTINGS), stopping_on_signals(stop.set):
        asyncio.run(_serve(execution, slots, stop))
    if stop.is_set():
        raise Interrupted("stopped; cells that ran here continue elsewhere")


def _constant_metric(text: str, worker: object) -> str:
    """Return `text`, the description of a worker's device; Dask calls this function for a worker metric."""
    return text


async def _serve(execution: Execution, slots: Sequence[DeviceSlot], stop: threading.Event) -> None:
    descriptions = [
        {
            "host": slot.worker,
            "device": slot.device,
            "bits": slot.bits,
            "memory": slot.memory,
            "code": code_digest(),
        }
        for slot in slots
    ]
    nannies = [
        distributed.Nanny(
            execution.address,
            nthreads=1,
            memory_limit=0,
            security=make_security(execution.tls),
            host=LOOPBACK if execution.is_local else None,
            metrics={METRIC_KEY: partial(_constant_metric, json.dumps(description))},
            dashboard_address=f"{LOOPBACK}:0",
            silence_logs=logging.CRITICAL,
        )
        for description in descriptions
    ]
    try:
        await asyncio.wait_for(asyncio.gather(*nannies), CONNECT_TIMEOUT_S)
    except (OSError, TimeoutError, RuntimeError) as error:
        raise scheduler_error(execution, error) from None
    while not stop.is_set() and any(nanny.status is distributed.Status.running for nanny in nannies):
        await asyncio.sleep(0.2)
    await asyncio.gather(*(nanny.close(timeout=5) for nanny in nannies))

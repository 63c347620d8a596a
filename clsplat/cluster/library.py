"""Dask, where it is installed, and how it is set.  Nothing else imports it.

Importing this module raises ConfigError without it.
"""

from typing import Any

from clsplat.cluster.connection import require_certificates
from clsplat.errors import ConfigError
from clsplat.pipeline.execution import Tls

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
    "distributed.worker.preload": ["clsplat.cluster.preload"],
    "distributed.worker.memory.target": False,  # of a worker's share of memory, which its child does not take from
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.comm.timeouts.connect": "60s",
}


def security(tls: Tls | None) -> Any:
    """Return the certificates as distributed takes them; None without.  Raises ConfigError."""
    if tls is None:
        return None
    require_certificates(tls)
    sides = {f"tls_{side}_{part}": getattr(tls, part) for side in SIDES for part in ("cert", "key")}
    return distributed.Security(tls_ca_file=tls.ca, require_encryption=True, **sides)

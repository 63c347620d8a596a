"""Make worker processes ignore Ctrl-C: the driver handles it, and lets the cells save their state before they stop."""

import signal


def dask_setup(worker: object) -> None:
    """Ignore Ctrl-C in this process.  Dask calls the function with this name in each worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

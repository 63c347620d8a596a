"""Make worker processes ignore Ctrl-C, because the driver handles it: it lets the cells save their state and stop."""

import signal


def dask_setup(worker: object) -> None:
    """Ignore Ctrl-C in this process.  Dask calls the function with this name in each worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

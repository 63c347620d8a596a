"""Make worker processes ignore Ctrl-C: the driver handles it, and lets the cells save their state and stop."""

import signal


def dask_setup(worker: object) -> None:
    """Ignore Ctrl-C.  Dask calls a function of this name."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

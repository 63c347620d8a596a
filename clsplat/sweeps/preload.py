"""What each worker process loads first: Ctrl-C is for the driver, which lets the cells save their state and stop."""

import signal


def dask_setup(worker: object) -> None:
    """Ignore Ctrl-C.  The name is that which Dask calls."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

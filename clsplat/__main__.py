"""Run the command line, as `clsplat` or as `python -m clsplat`."""

import os

from clsplat.core.signals import exit_on_signals


def main() -> None:
    """Run the command line.  Signals end it with exit code 130, even while modules are still being imported."""
    exit_on_signals()
    os.environ["PYTHONSAFEPATH"] = "1"  # -P for all child processes, including those of Dask and multiprocessing
    from clsplat.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()

"""Run the command `clsplat`, also as `python -m clsplat`."""

from clsplat.core.signals import exit_on_signals


def main() -> None:
    """Run the command line.  Signals end it in the same way while it is still being imported."""
    exit_on_signals()
    from clsplat.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()

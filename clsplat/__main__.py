"""The command `clsplat`, also as `python -m clsplat`."""

from clsplat.core.signals import exit_on_signals


def main() -> None:
    """Run the command line; a signal that comes while it is imported ends it as one that comes later."""
    exit_on_signals()
    from clsplat.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()

"""Dataset preparation: python -m data_tools COMMAND ..."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from clsplat.errors import ClsplatError
from data_tools.multiscale import write_multiscale
from data_tools.synthetic import Options, write_dataset

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def data_tools() -> None:
    """Prepare datasets for clsplat."""


@app.command()
def synthetic(
    out: Annotated[Path, typer.Argument(help="Folder to make.")],
    size: Annotated[int, typer.Option(min=8, help="Width and height of the images, pixels.")] = 256,
    train: Annotated[int, typer.Option(min=1, help="Number of training views.")] = 60,
    test: Annotated[int, typer.Option(min=1, help="Number of held-out views.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the surface points and their noise.")] = 0,
) -> None:
    """Ray-cast the demo scene: a still life with exact cameras, in the Blender (NeRF-synthetic) layout."""
    print(write_dataset(out, Options(size, train, test, seed)))


@app.command()
def multiscale(
    source: Annotated[Path, typer.Argument(help="Folder of a single-scale Blender dataset.")],
    out: Annotated[Path, typer.Argument(help="Folder to make.")],
    levels: Annotated[int, typer.Option(min=1, max=8, help="Scales: full size, half, quarter, …")] = 4,
) -> None:
    """Make the multi-scale Blender dataset of mip-NeRF from a single-scale one."""
    print(f"{write_multiscale(source, out, levels)} images written to {out}")


def main() -> None:
    """Run the command line; an error that the user can mend is one line and its exit code."""
    try:
        app()
    except ClsplatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()

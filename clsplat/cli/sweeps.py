"""Commands about the cells of a sweep."""

from pathlib import Path
from typing import Annotated

import typer

from clsplat import terminal
from clsplat.api import sweeps
from clsplat.cli.app import DeviceOption, PipelineArgument, SetOption, command

StoreOption = Annotated[Path, typer.Option("--store", metavar="DIR", help="The store of cells, a shared folder.")]


@command(
    "cell",
    "clsplat cell sweep.yaml --index 3 --store /shared/store",
    "clsplat cell splat_7k --scene my_scene --store runs/store",
)
def cell(
    pipeline: PipelineArgument,
    store: StoreOption,
    scene: Annotated[Path | None, typer.Option(metavar="DIR", help="The photographs, as for run.")] = None,
    index: Annotated[
        int | None,
        typer.Option(metavar="N", help="The cell of a matrix, counted from 0, such as $SLURM_ARRAY_TASK_ID."),
    ] = None,
    device: DeviceOption = None,
    set_: SetOption = None,
) -> None:
    """Run one cell of a matrix, unless its result is in the store; what every queue can call."""
    sweeps.run_cell(pipeline, store, scene, index=index, set=set_ or (), device=device)


@command("cancel", "clsplat cancel runs/store", "clsplat cancel runs/store seed=1")
def cancel(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="The store of cells.")],
    cell: Annotated[str | None, typer.Argument(metavar="[CELL]", help="A cell's name or key; default: all.")] = None,
) -> None:
    """Let cells that run, on whatever machine, save their state and stop."""
    terminal.remark(f"{store}: {sweeps.cancel(store, cell)} asked to stop")


@command(
    "worker",
    "clsplat worker --scheduler dask://127.0.0.1:8786",
    "clsplat worker --scheduler dask://head:8786 --insecure",
)
def worker(
    scheduler: Annotated[str, typer.Option(metavar="ADDRESS", help="dask://HOST:PORT, or tls://HOST:PORT.")],
    device: Annotated[
        list[str] | None, typer.Option("--device", metavar="NAME", help="A device; may be repeated; default: all.")
    ] = None,
    tls_ca: Annotated[str | None, typer.Option(metavar="FILE", help="Certificate of the authority, PEM.")] = None,
    tls_cert: Annotated[str | None, typer.Option(metavar="FILE", help="Certificate of this machine, PEM.")] = None,
    tls_key: Annotated[str | None, typer.Option(metavar="FILE", help="Its private key, PEM.")] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Without TLS: whoever reaches the scheduler's port can run code.")
    ] = False,
) -> None:
    """Offer the devices of this machine to a Dask scheduler, one process a device, until it ends."""
    sweeps.work_for(scheduler, device, tls=(tls_ca, tls_cert, tls_key), insecure=insecure)

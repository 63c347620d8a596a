"""Functions about the cells of a sweep; errors and `device` as in `clsplat.api.commands`."""

from collections.abc import Sequence
from pathlib import Path

from clsplat.api.arguments import Overrides, PathLike, load_plugins, overrides, path_of


def run_cell(
    pipeline: PathLike,
    store: PathLike,
    scene: PathLike | None = None,
    *,
    index: int | None = None,
    set: Overrides = (),
    device: str | None = None,
) -> Path:
    """Run one cell of a matrix, or a pipeline as a cell, and keep it in a store; return the folder of its result.

    index: of the cell in the matrix, from 0.  What is in the store already is not run again.
    """
    from clsplat.cluster.single import run_one
    from clsplat.runs.source import overrides_of

    load_plugins()
    return run_one(str(pipeline), Path(store), overrides_of(overrides(set), path_of(scene)), index, device)


def cancel(store: PathLike, cell: str | None = None) -> str:
    """Let the cells of a store that have begun save their state and stop, or one of them, by its name or key.

    Return the key, or "all".
    """
    from clsplat.cluster.store import Store

    return Store.opened(Path(store)).cancel(cell)


def work_for(
    scheduler: str,
    devices: Sequence[str] | None = None,
    *,
    tls: tuple[str | None, str | None, str | None] = (None, None, None),
    insecure: bool = False,
) -> None:
    """Offer the devices of this machine to a scheduler, dask://HOST:PORT or tls://HOST:PORT, until that ends.

    devices: names, default every device that works; tls: files of the authority, the certificate and its key.
    """
    from clsplat.cluster.offer import offer
    from clsplat.pipeline.execution import options

    load_plugins()
    certificates = {key: file for key, file in zip(("ca", "cert", "key"), tls, strict=True) if file} or None
    offer(options({"engine": scheduler, "insecure": insecure, "tls": certificates}), devices)

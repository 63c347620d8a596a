"""A model made small, or in levels of detail, as functions; errors and `device` as in `clsplat.api.commands`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from clsplat.api.arguments import PathLike, load_plugins, path_of

if TYPE_CHECKING:  # the command line starts without OpenCL
    from clsplat.opencl.device import Device


def compress_model(
    model: PathLike,
    scene: PathLike | None = None,
    target: str = "-0.1dB",
    out: PathLike = "runs/compress",
    *,
    format: Literal["sog", "spz"] = "sog",
    keep: Sequence[float] | None = None,
    steps: int | None = None,
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Look for the smallest file of a model that loses no more than `target`, or the best one of that size.

    model, scene: as for `render_views`; target: "-0.1dB" or "5MB"; out: a folder, which holds the file, a page and all
    that was tried; keep: shares of the Gaussians to try; steps: of training after each pruning,
    default 1000; with each palette it is a fifth of them.  Returns
    what compress.json holds, `file` and `page`.  Raises ConfigError for a target that no file meets.
    """
    from clsplat.compress import search

    load_plugins()
    shares = search.KEEPS if keep is None else keep
    folder = Path(out)
    return search.compress(
        Path(model), path_of(scene), target, folder, form=format, keeps=shares, steps=steps, device=device
    )


def write_levels(
    model: PathLike,
    folder: PathLike,
    scene: PathLike | None = None,
    *,
    levels: int = 4,
    keep: float = 0.5,
    steps: int | None = None,
    downscale: float | None = None,
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Write a model in levels of detail, as streamed SOG (lod-meta.json): each level has a share of the one before.

    model, scene: as for `render_views`, but without a scene nothing is trained, and ConfigError is raised for `steps`,
    `downscale` or `device`; levels: with the model itself; keep: the share; steps: of training each coarser level,
    default 500, 0 for none; downscale: divisor of the photographs' size there, by default that of the model's run.
    Returns `folder`, `bytes`, the `split` that is measured, and `levels` with
    `gaussians`, `bytes`, and in dB `merged_psnr`, before the training, and `psnr`.
    """
    from clsplat.lod.levels import levels_of_detail
    from clsplat.lod.training import Plan

    load_plugins()
    plan = Plan(levels, keep, steps, downscale)
    return levels_of_detail(Path(model), Path(folder), path_of(scene), plan, device)

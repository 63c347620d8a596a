"""A scene trained in blocks, as a function; errors and `device` as in `clsplat.api.commands`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from clsplat.api.arguments import PathLike, load_plugins, path_of

if TYPE_CHECKING:  # the command line starts without OpenCL
    from collections.abc import Sequence

    from clsplat.opencl.device import Device


def plan_in_blocks(
    scene: PathLike, pipeline: str = "blocks", *, blocks: int = 4, device: "str | Device | None" = None
) -> dict[str, Any]:
    """Return how a scene would be cut by its points, before anything is trained: what partition.json holds, and the
    time of each block, `seconds`, from some steps on the device.  Nothing is kept.
    """
    from clsplat.blocks.outlook import plan_blocks

    load_plugins()
    return plan_blocks(Path(scene), blocks, pipeline, device)


def train_in_blocks(
    scene: PathLike,
    out: PathLike = "runs/blocks",
    pipeline: str = "blocks",
    *,
    blocks: int = 4,
    coarse: PathLike = "blocks_coarse",
    sight: float = 0.05,
    steps: Literal["each", "shared"] = "each",
    overrides: "Sequence[str]" = (),
    coarse_overrides: "Sequence[str]" = (),
    only_plan: bool = False,
    on: PathLike | None = None,
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Train a scene in blocks: a coarse model is cut, each block is trained from what its views see, all are merged.

    out: a folder, in which an interrupted call goes on; coarse: a pipeline that trains the coarse model, or a model
    file or run; sight: the share of a view's pixels above which it belongs to a block; steps: of each block those of
    the pipeline, or its share of them by its views; overrides: 'stage.key=value'; only_plan: stop after the partition;
    on: a file that says where blocks are trained, as cells of a store, in the place of one after the other here.
    Returns what partition.json holds, `run`, the folder of the merged model, and `metrics`.
    """
    from clsplat.blocks.blocks import Plan, train_in_blocks
    from clsplat.pipeline.execution import Execution, values_of

    load_plugins()
    plan = Plan(pipeline, str(coarse), blocks, sight, steps, list(overrides), list(coarse_overrides))
    values = values_of(path_of(on))
    execution = None if values is None else Execution.model_validate(values)
    return train_in_blocks(Path(scene), Path(out), plan, device, only_plan=only_plan, execution=execution)

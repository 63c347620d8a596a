"""How long the training of each block takes, by what steps take on this machine now."""

from collections.abc import Mapping, Sequence

from clsplat.blocks.partition import Block
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline
from clsplat.runs.expected import DENSEST, most_of, step_seconds
from clsplat.stages.optimize import Optimize


def block_seconds(
    blocks: Sequence[Block], pipelines: Mapping[str, Pipeline], size: tuple[int, int], device: Device
) -> dict[str, list[float]]:
    """Return the time of the training of each block, s: with the Gaussians of its start, and with the most of them.

    pipelines: by the names of blocks; size: of a photograph, px.  The device is used for some seconds.
    """
    counts = {block.name: _counts(block, pipelines[block.name], size) for block in blocks}
    numbers = sorted({number for ends in counts.values() for number in ends})
    settings = pipelines[blocks[0].name].settings
    each = dict(zip(numbers, step_seconds(device, size, numbers, settings), strict=True))
    steps = {name: sum(training.steps for training in _trainings(pipelines[name])) for name in counts}
    return {name: [steps[name] * each[end] for end in ends] for name, ends in counts.items()}


def _counts(block: Block, pipeline: Pipeline, size: tuple[int, int]) -> tuple[int, int]:
    """The Gaussians that a block starts from, and the most that it may come to; without a setting that is a guess."""
    first, pixels = int(block.start.sum()), size[0] * size[1]
    own = [most_of(training, pixels) or block.pairs * DENSEST * pixels for training in _trainings(pipeline)]
    return first, max(first, int(max(own)) + first - block.gaussians)


def _trainings(pipeline: Pipeline) -> list[Optimize]:
    return [stage for stage in pipeline.stages if isinstance(stage, Optimize)]

"""How long the training of each block takes, roughly."""

from collections.abc import Mapping, Sequence

from clsplat.blocks.partition import Block
from clsplat.pipeline.loading import Pipeline
from clsplat.runs.expected import DENSEST, most_of, step_seconds
from clsplat.stages.optimize import Optimize


def block_seconds(
    blocks: Sequence[Block], pipelines: Mapping[str, Pipeline], size: tuple[int, int], units: int
) -> dict[str, list[float]]:
    """Return the time of the training of each block, s: at least, with the Gaussians of its start, and at most.

    pipelines: by the names of blocks; size: of a photograph, px; units: compute units of the device.
    """
    found = {}
    for block in blocks:
        ends = (step_seconds(units, size, count) for count in _counts(block, pipelines[block.name], size))
        steps = sum(training.steps for training in _trainings(pipelines[block.name]))
        found[block.name] = [steps * each[end] for end, each in enumerate(ends)]
    return found


def _counts(block: Block, pipeline: Pipeline, size: tuple[int, int]) -> tuple[int, int]:
    """The Gaussians that a block starts from, and the most that it may come to; without a setting that is a guess."""
    first, pixels = int(block.start.sum()), size[0] * size[1]
    own = [most_of(training, pixels) or block.pairs * DENSEST * pixels for training in _trainings(pipeline)]
    return first, max(first, int(max(own)) + first - block.gaussians)


def _trainings(pipeline: Pipeline) -> list[Optimize]:
    return [stage for stage in pipeline.stages if isinstance(stage, Optimize)]

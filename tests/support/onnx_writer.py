"""ONNX files of a few operators."""

from collections.abc import Sequence

import numpy as np

from clsplat.data_tools.lpips import Graph


def distance_network(inputs: Sequence[str] = ("in0", "in1"), offset: float = 0.0) -> bytes:
    """Return a model of the mean squared difference of two [1, 3, h, w] images, plus `offset`."""
    graph = Graph()
    difference = graph.add("Sub", *inputs)
    by_channel = graph.add("ReduceMean", graph.add("Mul", difference, difference), axes=(2, 3))
    mean = graph.add("ReduceMean", by_channel, axes=(1,))
    return graph.model(inputs, graph.add("Add", mean, graph.constant("offset", np.full((1,), offset))))

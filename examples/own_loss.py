"""Add a loss written in NumPy to the losses of a pipeline: `python own_loss.py SCENE [PIPELINE]`."""

import sys

import numpy as np

import clsplat


def edge_loss(image, photograph):
    """Return the mean absolute difference of the image gradients, and its derivative with respect to `image`.

    image, photograph: [height, width, 3] float32.
    """
    value, derivative = 0.0, np.zeros_like(image)
    for axis in (0, 1):
        slopes = np.diff(image - photograph, axis=axis)
        value += float(np.abs(slopes).mean())
        derivative -= np.diff(np.sign(slopes) / slopes.size, axis=axis, prepend=0, append=0)
    return value, derivative


def main(scene: str, pipeline: str = "splat_7k") -> None:
    trainer = clsplat.Trainer(scene, pipeline)
    trainer.add_loss(edge_loss, weight=0.1)
    for report in trainer.steps():
        if report.step % 100 == 0:
            print(f"step {report.step}: loss {report.loss:.4f}, {report.gaussians:,} Gaussians")
    print(trainer.evaluate("test"))
    trainer.model.save("own_loss.ply")


if __name__ == "__main__":
    main(*sys.argv[1:])

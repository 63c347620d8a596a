"""A model that needs every part of the shaders, and cameras that need every part of the projection."""

from dataclasses import replace

import numpy as np

from clsplat.formats.splats import motion_fields
from clsplat.gaussians.model import Model, Rendering
from clsplat.scene.camera import Camera
from clsplat.scene.scene import Scene, make_scene
from clsplat.scene.view import View

SIZE = 112, 80  # px
PLAIN = Rendering(near=0.2, screen_variance=0.3, compensate=0.0, background="white")
MIP = Rendering(near=0.2, screen_variance=0.1, compensate=1.0, background="black")


def cloud(count: int, rendering: Rendering = PLAIN, degree: int = 3, seed: int = 0) -> Model:
    """A ball of flat and of long splats, a few of them behind all cameras and a few far away."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0, 0.45, (count, 3))
    means[::97] *= 30
    return Model(
        means=means,
        quats=rng.normal(0, 1, (count, 4)),
        log_scales=rng.normal(-3.6, 0.8, (count, 3)),
        logit_opacity=rng.normal(0, 2.5, (count, 1)),
        sh_base=rng.normal(0, 1, (count, 3)),
        sh_rest=rng.normal(0, 0.15, (count, 3 * ((degree + 1) ** 2 - 1))),
        rendering=rendering,
    )


def moving(model: Model, width: int = 15, seed: int = 1) -> Model:
    """The same splats, which come, go, bend their way and turn, as far as `width` columns of motion hold that."""
    rng, fields = np.random.default_rng(seed), motion_fields(width)
    motion = np.zeros((len(model), width))
    spread = {"velocity": 0.8, "acceleration": 0.5, "jerk": 0.5, "turn": 1.0}
    for name, columns in fields.items():
        motion[:, columns] = rng.normal(0, spread.get(name, 0.0), (len(model), columns.stop - columns.start))
    motion[:, fields["time_center"]] = rng.uniform(0, 1, (len(model), 1))
    motion[:, fields["log_duration"]] = rng.normal(-1.2, 1, (len(model), 1))
    return replace(model, motion=motion.astype(np.float32))


def views() -> list[View]:
    """Four views: centered, off-center and of two focal lengths, rolled, and inside of the ball."""
    width, height = SIZE
    lenses = [
        Camera(width, height, 90.0, 90.0, width / 2, height / 2),
        Camera(width, height, 80.0, 104.0, 0.3 * width, 0.7 * height),
        Camera(height, width, 95.0, 95.0, 31.0, 60.5),
        Camera(width, height, 60.0, 60.0, 61.0, 37.0),
    ]
    eyes = [(0.3, -0.5, -3.0), (2.4, 0.4, -1.2), (-1.5, -2.0, 1.5), (0.1, 0.1, -0.5)]
    ups = [(0.0, -1.0, 0.0), (0.1, -1.0, 0.1), (1.0, -0.6, 0.3), (0.0, -1.0, 0.2)]
    names = ["a/0001.png", "a/0002.png", "0003.png", "0004.png"]
    return [
        View.looking_at(eye, (0.0, 0.05, 0.1), up, lens, name)
        for eye, up, lens, name in zip(eyes, ups, lenses, names, strict=True)
    ]


def scene(path) -> Scene:
    """The views, the first and the last held out."""
    return make_scene(path, views(), {0, 3}, None)

"""The scene of a run as it is trained on, with every photograph decoded."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from clsplat.errors import amount
from clsplat.pipeline.file import SceneSettings
from clsplat.scene.decoding import decode_all, require_whole
from clsplat.scene.detect import read_scene
from clsplat.scene.identity import Identity
from clsplat.scene.scene import SPLITS, Background, Scene

LOG = logging.getLogger("clsplat")
FEWEST = 3  # training photographs without a warning at the start


@dataclass(frozen=True, eq=False)
class RunScene:
    """A scene with the settings of a run."""

    original: Scene  # as read
    scene: Scene  # as trained on: at one size or several
    background: Background
    identity: Identity

    @classmethod
    def of(cls, settings: SceneSettings, scene: Scene) -> "RunScene":
        """Apply the settings to a scene, and decode its photographs.

        Raises DataError, naming the files, when some of the training or test photographs and masks cannot be used.
        """
        original, background = settings.applied(scene)
        downscaled = original.downscaled(*settings.downscales)
        camera = downscaled.views[0].camera
        LOG.info(
            "scene: %s, %d training%s and %d test views, %d x %d px, %s background, extent %.3g",
            *(
                scene.path,
                len(downscaled.train),
                f", {len(downscaled.validation)} validation" if downscaled.validation else "",
                len(downscaled.test),
                camera.width,
                camera.height,
                background,
                downscaled.extent,
            ),
        )
        if len(original.train) < FEWEST:
            LOG.warning(
                "%s: is trained on %s: a model of fewer than %d fits these and shows little else; add photographs, or "
                "put back those that are missing",
                *(scene.path, amount(len(original.train), "photograph"), FEWEST),
            )
        files = decode_all(view for one in (original, downscaled) for split in SPLITS for view in one.split(split))
        require_whole(scene.path, files)
        return cls(original, downscaled, background, Identity.of(original, files))


ReadScene = Callable[[SceneSettings, Path], RunScene]


def read_run_scene(settings: SceneSettings, folder: Path) -> RunScene:
    """Read the scene in a folder with these settings.  Raises DataError."""
    return RunScene.of(settings, read_scene(folder, settings.split))

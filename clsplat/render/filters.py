"""Define the settings of `model:`: the degree of the harmonics, and two low-pass filters.

A world filter writes `filter_variance`, scene units², which is added to the squared scales of each Gaussian.  A screen
filter sets three parameters of the model.  Rendering reads only these values, and does not depend on the filters.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from clsplat.core.errors import ConfigError
from clsplat.core.settings import OneOf, Settings, in_one_sentence
from clsplat.formats.ply import MAX_NUMBER
from clsplat.formats.splats import MAX_DEGREE, motion_width
from clsplat.gaussians.gaussians import DeviceModel, Gaussians
from clsplat.opencl.device import Array, Device
from clsplat.render.backdrops import Backdrop, EnvironmentMap
from clsplat.render.camera import camera_values
from clsplat.scene.view import View

BOX_VARIANCE = 1 / 12  # px²


class FilterViews:
    """The cameras of training views on the device, [V] camera_t, and their focal lengths, [V] px."""

    def __init__(self, device: Device, views: Sequence[View]) -> None:
        tile = int(device.tuning["TILE"])
        self.cameras: Array = device.upload(np.stack([camera_values(view, tile) for view in views]))
        self.focal: NDArray[np.float32] = np.array([view.camera.fx for view in views], np.float32)


AT_REST = {"motion": "it uses the positions of Gaussians at their time centers, not at the time of a view"}


class WorldFilter(Settings):
    """A blur of Gaussians in the world."""

    @abstractmethod
    def refresh(self, gaussians: Gaussians, views: FilterViews, near: float) -> None:
        """Write `filter_variance`, [S] scene units², for the current means.  near: minimum depth in scene units."""


class NoWorldFilter(WorldFilter):
    """No blur in the world."""

    type: Literal["none"] = "none"

    def refresh(self, gaussians: Gaussians, views: FilterViews, near: float) -> None:
        pass


class Smoothing(WorldFilter):
    """Blur Gaussians to the training views' resolution (3D smoothing filter of Mip-Splatting, Yu et al. 2024).

    A view of focal length f px samples a Gaussian at depth z every z/f scene units.  `per_camera` uses the smallest
    such interval (eq. 6); `global_max` uses the smallest z and the largest f of all views, as in the paper's code.
    """

    conflicts: ClassVar[Mapping[str, str]] = {
        "motion": f"{AT_REST['motion']}; set model.world_filter: none, or remove model.time"
    }
    type: Literal["smoothing"] = "smoothing"
    variance: Annotated[float, Field(ge=0)] = 0.2
    """Variance added to the squared scales, in sampling intervals²."""
    focal: Literal["per_camera", "global_max"] = "per_camera"
    """Focal length for the interval: that of each view, or the largest of all."""

    def refresh(self, gaussians: Gaussians, views: FilterViews, near: float) -> None:
        focal = np.full_like(views.focal, views.focal.max()) if self.focal == "global_max" else views.focal
        measure_intervals(gaussians, views, focal, near, self.variance, gaussians["filter_variance"])


def measure_intervals(
    gaussians: Gaussians, views: FilterViews, focal: NDArray[np.float32], near: float, factor: float, squared: Array
) -> None:
    """Write `factor` times the squared sampling interval of each Gaussian, [S] scene units².  focal: [V] px."""
    device, program = gaussians.device, gaussians.device.program("filter.cl")
    largest = device.zeros(1, np.uint32)
    items = -(-gaussians.count // int(device.tuning["LANES"]))
    program.sampling_interval(
        items=items,
        means=gaussians["means"],
        cameras=views.cameras,
        focal=device.upload(focal),
        interval=squared,
        largest=largest,
        near_plane=near,
        views=len(focal),
        stride=gaussians.capacity,
        count=gaussians.count,
    )
    program.filter_variance(items=items, largest=largest, interval=squared, variance=factor, count=gaussians.count)


class ScreenFilter(Settings):
    """A blur of splats in the image.  A subclass with more keys must override `parameters`."""

    pixel_box: ClassVar[bool] = False  # whether to integrate splats over a pixel's box; other fields are for viewers
    variance: Annotated[float, Field(ge=0, lt=MAX_NUMBER)]
    """Variance added to every splat, px²."""
    compensate: Literal[0, 1]
    """1: reduce the opacity as the area grows, so that a splat keeps its energy."""

    @classmethod
    def __pydantic_init_subclass__(cls, **values: Any) -> None:
        super().__pydantic_init_subclass__(**values)
        keys = [name for name in cls.model_fields if name not in (*ScreenFilter.model_fields, "type")]
        if keys and cls.parameters is ScreenFilter.parameters:
            raise ConfigError(f"{cls.__name__}: its key '{keys[0]}' has no effect; override ScreenFilter.parameters")

    def parameters(self) -> tuple[float, float, float]:
        """Return `variance`, `compensate`, and 1 to integrate splats over the pixel's box, otherwise 0."""
        return self.variance, float(self.compensate), float(self.pixel_box)


class Dilation(ScreenFilter):
    """Add a variance to every splat, so that each covers about a pixel or more (Kerbl et al. 2023)."""

    type: Literal["dilation"] = "dilation"
    variance: Annotated[float, Field(ge=0, lt=MAX_NUMBER)] = 0.3
    """Variance added to every splat, px²."""
    compensate: Literal[0, 1] = 0
    """1: reduce the opacity as the area grows, so that a splat keeps its energy."""


class Ewa(ScreenFilter):
    """Add a variance to every splat and keep its energy (Zwicker et al. 2001; "3DGS + EWA" in Yu et al. 2024)."""

    type: Literal["ewa"] = "ewa"
    variance: Annotated[float, Field(ge=0, lt=MAX_NUMBER)] = 0.3
    """Variance added to every splat, px²."""
    compensate: Literal[0, 1] = 1
    """1: reduce the opacity as the area grows, so that a splat keeps its energy."""


class Mip(ScreenFilter):
    """Blur every splat by about a pixel and keep its energy (2D Mip filter, Yu et al. 2024, eq. 11)."""

    type: Literal["mip"] = "mip"
    variance: Annotated[float, Field(ge=0, lt=MAX_NUMBER)] = 0.1
    """Variance added to every splat, px²."""
    compensate: Literal[0, 1] = 1
    """1: reduce the opacity as the area grows, so that a splat keeps its energy."""


def _require_box_variance(variance: float) -> float:
    if variance != BOX_VARIANCE:
        raise ValueError(f"'box' has a fixed variance of {BOX_VARIANCE}; write `screen_filter: box`")
    return variance


class BoxFilter(ScreenFilter):
    """Integrate every splat over the box of each pixel, instead of evaluating it at the pixel's center.

    For splats larger than a pixel, this is close to a Gaussian blur with the box's variance, 1/12 px², which programs
    without a box filter use instead.  The integral is in `cl_kernels/pixel_box.h`.
    """

    pixel_box: ClassVar[bool] = True
    type: Literal["box"] = "box"
    variance: Annotated[float, AfterValidator(_require_box_variance)] = BOX_VARIANCE
    """Variance of the box, px², for programs that use a Gaussian blur instead; it cannot be changed."""
    compensate: Literal[1] = 1
    """1, since integration over the box keeps the energy of a splat; it cannot be changed."""


class Motion(Settings):
    """Motion of Gaussians over the time of a scene: polynomial positions, and opacities that follow a bell curve."""

    family: ClassVar[str] = "motion"

    degree: Annotated[int, Field(ge=1, le=MAX_DEGREE)] = 1
    """Degree of the polynomial in time for means: 1 in FreeTimeGS, 3 in Spacetime Gaussians."""
    rotation: bool = False
    """Whether Gaussians also rotate, at a constant rate."""

    @property
    def width(self) -> int:
        """The number of columns of the motion table."""
        return motion_width(self.degree, self.rotation)


class ModelSettings(Settings):
    """Settings for rendering Gaussians."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"near_auto"})

    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Highest degree of the spherical harmonics."""
    near: Annotated[
        Literal["auto"] | Annotated[float, Field(gt=0, lt=MAX_NUMBER)],
        in_one_sentence(f"expected 'auto' or a depth above 0 and below {MAX_NUMBER:g}"),
    ] = "auto"
    """Smallest depth in scene units that is rendered; `auto`: 4% of the scene's extent, or half of the 1% quantile of
    the depths of observed points, if that is less.  A run writes the value."""
    near_auto: Annotated[float, Field(gt=0, lt=MAX_NUMBER)] | None = None
    """Written by a run: the value that `auto` chose.  If `near` still equals it, other photos replace both."""
    world_filter: OneOf[WorldFilter] = NoWorldFilter()
    """Blur of Gaussians in the world."""
    screen_filter: OneOf[ScreenFilter] = Dilation()
    """Blur of splats in the image."""
    background: OneOf[Backdrop] | None = None
    """Background behind the Gaussians: `envmap` (a learned sky) or `auto`; default: `scene.background`."""
    time: Motion | None = None
    """Motion of Gaussians, in a scene whose views have times; default: they do not move."""

    @property
    def sky(self) -> EnvironmentMap | None:
        """The settings of the learned sky; None if there is none, or `auto` has not chosen yet."""
        return self.background.sky if self.background else None

    def model(self, gaussians: Gaussians, degree: int) -> DeviceModel:
        """Return the Gaussians with the rendering parameters of these settings.  degree: the active SH degree."""
        assert self.near != "auto"  # a run chooses it before its first stage
        return DeviceModel(gaussians, degree, self.near, *self.screen_filter.parameters())

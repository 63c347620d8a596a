"""Render Gaussians, and compute their gradients from the gradient of the image."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import MemoryLimitError
from clsplat.gaussians.gaussians import DeviceModel, Gaussians, visibility_arguments
from clsplat.gaussians.sh_offload import slot_arguments
from clsplat.gaussians.structs import GaussianGradients
from clsplat.opencl.device import Array, Device, Program, constants
from clsplat.render.camera import DeviceCamera
from clsplat.render.motion import backpropagate_motion, evaluate_motion
from clsplat.render.sky import Skies
from clsplat.render.tiles import Band, Footprints, Sort, TileLists, Tiler, TooManyPairs
from clsplat.render.workspace import Workspace

# Sums of gradient records over the pairs of each Gaussian, including those of the blended inverse depth.

INVERSE_DEPTHS = "inverse_depth_sums"  # name in the workspace


def sum_defines(pixel_sums: Array) -> dict[str, int]:
    """Return the macro with the number of sums, unless it is the default.  pixel_sums: [count, S]."""
    return {} if pixel_sums.shape[0] == PIXEL_SUMS else {"PIXEL_SUMS": pixel_sums.shape[0]}


def sum_records(pair_sums: Array, lists: TileLists, gaussians: Gaussians, pixel_sums: Array, accumulate: int) -> None:
    """Sum the records of pairs, [P, RECORD], for each Gaussian, into `pixel_sums`, [PIXEL_SUMS, S].

    accumulate: 1 to add to existing sums.
    """
    device = gaussians.device
    device.program("gather.cl", **sum_defines(pixel_sums)).sum_records(
        items=-(-gaussians.count // int(device.tuning["LANES"])),
        pair_sums=pair_sums,
        first_pair=lists.first_pair,
        tile_count=lists.tile_count,
        pixel_sums=pixel_sums,
        accumulate=accumulate,
        stride=gaussians.capacity,
        count=gaussians.count,
    )


def sum_inverse_depths(
    workspace: Workspace, pair_sums: Array, lists: TileLists, gaussians: Gaussians, accumulate: int
) -> Array:
    """Return the sum of w dL/dD over the pixels of each Gaussian, [S].  accumulate: 1 to add to existing sums."""
    sums = workspace.array(INVERSE_DEPTHS, gaussians.capacity)
    workspace.device.program("inverse_depth.cl").sum_inverse_depths(
        items=gaussians.count,
        pair_sums=pair_sums,
        first_pair=lists.first_pair,
        tile_count=lists.tile_count,
        sums=sums,
        accumulate=accumulate,
        count=gaussians.count,
    )
    return sums


def add_inverse_depth_gradient(workspace: Workspace, camera: DeviceCamera, splats: Array, grad_means: Array) -> None:
    """Add the gradient through the inverse depth to `grad_means`.  splats: [N, RECORD].

    Uses the sums of the last call of `sum_inverse_depths`.
    """
    count, capacity = splats.shape[0], grad_means.shape[1]
    workspace.device.program("inverse_depth.cl").inverse_depth_backward(
        items=count,
        splats=splats,
        sums=workspace.array(INVERSE_DEPTHS, capacity),
        camera=camera.array,
        grad_means=grad_means,
        stride=capacity,
        count=count,
    )


def projection_arguments(model: DeviceModel, camera: DeviceCamera) -> dict[str, Any]:
    """Return the arguments shared by all kernels that project Gaussians, by name.

    Harmonics of Gaussians outside the view may have deferred updates; these kernels do not read them.
    """
    gaussians = model.gaussians
    names = ("means", "quats", "log_scales", "logit_opacity", "sh_rest", "filter_variance")
    return {
        **{name: gaussians.tables[name].array for name in names},
        "camera": camera.array,
        "near_plane": model.near,
        "screen_variance": 0.0 if model.pixel_box else model.screen_variance,
        "compensate": 0.0 if model.pixel_box else model.compensate,
        "degree": model.degree,
        **slot_arguments(gaussians),
        "stride": gaussians.capacity,
        "count": gaussians.count,
    }


RECORD = int(constants()["RECORD"])


@dataclass(frozen=True)
class ProjectedSplats:
    """The splats of a model in a band of tiles."""

    splats: Array  # [N, RECORD]
    radius: Array  # [S] px
    footprints: Footprints


def project(
    workspace: Workspace, model: DeviceModel, camera: DeviceCamera, band: Band, visibility: Mapping[str, Any]
) -> ProjectedSplats:
    """Project the Gaussians of a model; the projection is valid until the next call.

    visibility: see `visibility_arguments`.
    """
    gaussians = model.gaussians
    device, count, stride = gaussians.device, gaussians.count, gaussians.capacity
    splats, radius = workspace.array("splats", (count, RECORD)), workspace.array("radius", stride)
    footprints = Footprints(*(workspace.array(field.name, stride, np.uint32) for field in fields(Footprints)))
    device.program("project.cl", **model.defines).project_forward(
        items=-(-count // int(device.tuning["LANES"])),
        **projection_arguments(model, camera),
        sh_base=gaussians["sh_base"],
        **visibility,
        splats=splats,
        **vars(footprints),
        radius=radius,
        row_begin=band.row_begin,
        row_end=band.row_end,
    )
    return ProjectedSplats(splats, radius, footprints)


def update_visible_harmonics(workspace: Workspace, model: DeviceModel, camera: DeviceCamera) -> None:
    """Apply the deferred updates of Gaussians in the view, and fetch their harmonics from the host.

    A projection without harmonics determines which Gaussians are in the view.
    """
    deferred, on_host = model.gaussians.deferred, model.gaussians.on_host
    if on_host or (deferred and deferred.updates):
        empty_band = Band(camera.tiles_x, camera.tiles_y, 0, 0)
        mask = workspace.array("left_out", model.gaussians.capacity)
        visibility = visibility_arguments(model, camera.view_index, mask)
        depth_key = project(workspace, replace(model, degree=0), camera, empty_band, visibility).footprints.depth_key
        if on_host:
            on_host.upload_visible(depth_key)
        if deferred:
            deferred.flush_visible(depth_key)


PIXEL_SUMS = int(constants()["PIXEL_SUMS"])
POSE_SUMS, POSE_GROUP = (int(constants("poses.cl")[name]) for name in ("POSE_SUMS", "POSE_GROUP"))
MAX_PAIRS = 2**31  # sums of pairs have 32 bits
BUCKET = int(constants()["BUCKET"])
Content = Literal["color", "depth", "inverse_depth"]
# color: three planes of color.  depth: the blended depth of the means, alpha, and the median depth (0: none), in scene
# units.  inverse_depth: the color, and a fourth plane with the blended inverse depth of the means.
DEFINES = {"inverse_depth": {"INVERSE_DEPTH": 1}, "depth": {"MEDIAN_DEPTH": 1}}


@dataclass(frozen=True)
class Frame:
    """The images and tile lists of a forward pass, read by losses and the backward pass; valid until the next one."""

    camera: DeviceCamera
    splats: Array  # [N, RECORD]
    depth_key: Array  # [S] bits of the depth; all ones if the splat was culled
    radius: Array  # [S] px, 3 standard deviations; 0 if not visible
    lists: TileLists
    tile_last: Array  # [T] number of pairs of each tile up to the last one that a pixel blends
    image: Array  # [3, rows, stride], zero outside the image; with a fourth plane [4, rows, stride]
    transmittance: Array  # [rows, stride]
    bands: list[Band]  # `lists` belongs to the last one
    content: Content  # content of the planes
    model: DeviceModel  # the rendered model; a moving one at the timestamp of the camera

    @property
    def key(self) -> tuple[int, ...]:
        """Numbers that identify the memory of the frame and of its lists, as a part of the keys of plans."""
        arrays = self.splats, self.radius, self.depth_key, self.tile_last, self.image, self.transmittance
        return tuple(array.buffer.serial for array in arrays)


def pose_gradient(
    workspace: Workspace, model: DeviceModel, frame: Frame, pixel_sums: Array
) -> Callable[[], NDArray[np.float64]]:
    """Return a function that waits for the pose gradient of the loss and returns it, [7].

    It contains the gradients with respect to a translation of all Gaussians, their rotation about the camera in world
    axes, and the logarithm of a factor on the focal lengths.  pixel_sums: of the frame, [PIXEL_SUMS, S].
    """
    device = workspace.device
    items = -(-model.gaussians.count // int(device.tuning["LANES"]))
    sums = workspace.array("pose sums", (POSE_SUMS, -(-items // POSE_GROUP)))
    arguments = projection_arguments(frame.model, frame.camera)
    device.program("poses.cl", **model.defines).pose_gradient(
        items=items, **arguments, splats=frame.splats, pixel_sums=pixel_sums, sums=sums
    )
    read_group_sums = sums.get_later()
    return lambda: np.cumsum(read_group_sums(), axis=1, dtype=np.float64)[:, -1]


class PixelSums:
    """Sums over each Gaussian's pixels, stored as records of pairs until `array` is read or a kernel sums them."""

    def __init__(self, array: Array, pairs: dict[str, Array], launch: Callable[[], None] | None) -> None:
        """launch: sums the records of `pairs` into `array`, [count, S]; None if `array` has the sums."""
        self._array, self._pairs, self._launch = array, pairs, launch

    @property
    def array(self) -> Array:
        """The sums, [count, S].  The first access sums the records."""
        if self._launch:
            self._launch()
            self._launch = None
        return self._array

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of a kernel that sums records itself unless `array` has their sums."""
        return {"pixel_sums": self._array, **self._pairs, "has_pairs": int(self._launch is not None)}


@dataclass(frozen=True)
class RenderLimits:
    """Limits on memory and launches; results do not depend on them."""

    pairs: int  # (tile, Gaussian) pairs in memory
    tiles: int = 0  # tiles per launch; 0: all


class Rasterizer:
    """Renders one frame at a time, and reuses its buffers."""

    def __init__(self, device: Device, sort: Sort = "auto", budget: RenderLimits | None = None) -> None:
        self.device, self._lanes = device, int(device.tuning["LANES"])
        self.budget = budget or RenderLimits(MAX_PAIRS)
        self._limit = min(self.budget.pairs, device.info.allocation // (4 * RECORD), MAX_PAIRS)  # in one buffer
        self._bands: dict[int, int] = {}  # rows of tiles of a frame -> number of bands
        self.workspace = Workspace(device)
        self.tiler = Tiler(device, self.workspace, sort)
        self.skies = Skies(device, self.workspace)
        self._black = device.zeros(3)
        device.program("project.cl")  # compiled now, like the other programs
        self._blend("color")
        self._gradients: GaussianGradients | None = None  # allocated at first use

    def forward(self, model: DeviceModel, camera: DeviceCamera, background: Array, content: Content = "color") -> Frame:
        """Render the model.  background: [3], used if the model has no sky.

        If the pairs of all tiles exceed the budget or the device's memory, the frame is rendered in bands of rows, with
        bit-identical results.  Waits for the number of pairs.  Raises MemoryLimitError if a single row does not fit.
        """
        while not self.is_complete(frame := self.start_forward(model, camera, background, content)):
            pass
        return frame

    def is_complete(self, frame: Frame) -> bool:
        """Wait for the number of pairs, and return whether they fit; if not, `start_forward` must be repeated."""
        try:
            return self.tiler.has_room(frame.lists)
        except TooManyPairs:
            self._halve_bands(frame.camera)  # `start_forward` raises an error if a single row does not fit
            return False

    def start_forward(
        self, model: DeviceModel, camera: DeviceCamera, background: Array, content: Content = "color"
    ) -> Frame:
        """Render the model like `forward` without waiting; `is_complete` returns whether the frame is valid."""
        sky = model.sky if content != "depth" else None
        model = evaluate_motion(self.workspace, model, camera)
        update_visible_harmonics(self.workspace, model, camera)
        while True:
            try:
                frame = self._forward(model, camera, self._black if sky else background, content)
                if sky:
                    self.skies.paint(sky, camera, frame.image, frame.transmittance)
                return frame
            except TooManyPairs as error:
                self._split_pairs(camera, error)
            except MemoryLimitError:
                if not self._halve_bands(camera):
                    raise

    def _split_pairs(self, camera: DeviceCamera, error: TooManyPairs) -> None:
        if not self._halve_bands(camera):
            raise MemoryLimitError(
                f"an image of {camera.width}x{camera.height} px has a row of tiles with more than "
                f"{MAX_PAIRS:,} (tile, Gaussian) pairs; use smaller images, or fewer Gaussians"
            ) from error

    def _halve_bands(self, camera: DeviceCamera) -> bool:
        """Halve the height of the bands; return whether any had more than one row of tiles."""
        self.tiler.reset_capacity()
        band_count = self._bands.get(camera.tiles_y, 1)
        self._bands[camera.tiles_y] = 2 * band_count
        return band_count < camera.tiles_y

    def _forward(self, model: DeviceModel, camera: DeviceCamera, background: Array, content: Content) -> Frame:
        bands = self._split(camera)
        for band in bands:
            projection, lists = self._list_band(model, camera, band, content)
            planes = self._blend_band(model, camera, band, background, content, projection.splats, lists)
        splats, radius, depth_key = projection.splats, projection.radius, projection.footprints.depth_key
        return Frame(camera, splats, depth_key, radius, lists, *planes, bands, content, model)

    def _blend_band(
        self,
        model: DeviceModel,
        camera: DeviceCamera,
        band: Band,
        background: Array,
        content: Content,
        *splats: Any,
        prefix: str = "",
    ) -> tuple[Array, Array, Array]:
        """Blend a band; return `tile_last`, the image, and the transmittance.

        splats: their records and lists; prefix: start of the names of the image and transmittance in the workspace.
        """
        records, lists = splats

        def blend() -> tuple[Array, Array, Array]:
            array = self.workspace.array
            image = array(f"{prefix}image", (4 if content == "inverse_depth" else 3, camera.rows, camera.stride))
            transmittance = array(f"{prefix}transmittance", (camera.rows, camera.stride))
            tile_last = array("tile_last", camera.tiles, np.uint32)
            for first_tile, groups in self._launches(band):
                self._blend(content, **model.defines).blend_forward(
                    groups=groups,
                    tile_offset=lists.tile_offset,
                    tile_pairs=lists.tile_pairs,
                    pair_splat=lists.pair_splat,
                    splats=records,
                    background=background,
                    camera=camera.array,
                    image=image,
                    transmittance=transmittance,
                    tile_last=tile_last,
                    **self._buckets(lists, camera, content),
                    first_tile=first_tile,
                )
            return tile_last, image, transmittance

        key = "blend", model.key, camera.size, content, band, self.budget.tiles, lists.key, prefix
        return self.workspace.plans.run(key, {"camera": camera.array, "background": background}, blend)

    def _buckets(self, lists: TileLists, camera: DeviceCamera, content: Content) -> dict[str, Any]:
        """Return the arrays with which the backward pass of simt divides long lists, by name; see blend_simt.cl."""
        if self._lanes > 1:
            return {}
        count, floats = lists.capacity // BUCKET + 1, 5 if content == "inverse_depth" else 4
        return {
            "bucket_tile": self.workspace.array("bucket_tile", count, np.uint32),
            "states": self.workspace.array("bucket_states", (count, floats * camera.tile**2)),
        }

    def _blend(self, content: Content, **defines: int) -> Program:
        """Return the blending kernels for the content of a frame, such as depth."""
        schedule = "simt" if self._lanes == 1 else "wide"
        return self.device.program(f"blend_{schedule}.cl", **defines, **DEFINES.get(content, {}))

    def _split(self, camera: DeviceCamera) -> list[Band]:
        band_count = min(self._bands.get(camera.tiles_y, 1), camera.tiles_y)
        if band_count == 1:
            return [Band(camera.tiles_x, camera.tiles_y, 0, camera.tiles_y)]
        rows = np.linspace(0, camera.tiles_y, band_count + 1).astype(int)
        return [Band(camera.tiles_x, camera.tiles_y, int(begin), int(end)) for begin, end in pairwise(rows)]

    def _launches(self, band: Band, buckets: int = 0) -> list[tuple[int, int]]:
        """Return the first tile and the number of tiles of each launch; watchdogs may limit the time of a launch.

        buckets: number of groups after those of the tiles.
        """
        step = self.budget.tiles or band.tiles_inside + buckets
        end = band.first_tile + band.tiles_inside + buckets
        return [(first, min(step, end - first)) for first in range(band.first_tile, end, step)]

    def _list_band(
        self, model: DeviceModel, camera: DeviceCamera, band: Band, content: Content
    ) -> tuple[ProjectedSplats, TileLists]:
        """Project the splats, and list those of each tile."""
        gaussians, rows = model.gaussians, band.row_end - band.row_begin
        mask = self.workspace.array("left_out", gaussians.capacity)
        visibility = visibility_arguments(model, camera.view_index, mask)

        def launch() -> ProjectedSplats:
            projection = project(self.workspace, model, camera, band, visibility)
            if content == "depth":
                self.device.program("depth.cl").paint_depth(
                    items=gaussians.count,
                    means=gaussians["means"],
                    camera=camera.array,
                    splats=projection.splats,
                    stride=gaussians.capacity,
                    count=gaussians.count,
                )
            return projection

        key = "project", model.key, camera.size, band, content
        limit = MAX_PAIRS if rows == 1 else self._limit  # a single row cannot be split further
        while True:
            projection = self.workspace.plans.run(key, {**visibility, "camera": camera.array}, launch)
            inputs = projection.splats, projection.footprints, band, gaussians.count
            lists = self.tiler.build(*inputs, limit, model.defines)
            if rows == camera.tiles_y or self.tiler.has_room(lists):  # the lists of several bands share their memory
                return projection, lists

    def pixel_sums(
        self,
        model: DeviceModel,
        frame: Frame,
        grad_image: Array,
        count: int = PIXEL_SUMS,
        texture: Array | None = None,
        transmittance_gradient: Array | None = None,
    ) -> Array:
        """Return the sums over each Gaussian's pixels that determine its gradients, [count, S] (cl_kernels/splat.h).

        grad_image: in the layout of the frame's image, zero outside it.  A `count` above PIXEL_SUMS is slower; texture
        sums need `texture`, [rows, stride], negative if unknown.  transmittance_gradient: [rows, stride] T dL/dT of a
        loss on the transmittance T.  Memory is limited as in `forward`.
        """
        return self.backward(model, frame, grad_image, count, texture, transmittance_gradient).array

    def backward(
        self,
        model: DeviceModel,
        frame: Frame,
        grad_image: Array,
        count: int = PIXEL_SUMS,
        texture: Array | None = None,
        transmittance_gradient: Array | None = None,
    ) -> PixelSums:
        """Return the result of `pixel_sums`, valid until the next call; the records of pairs may not be summed yet."""
        bands = frame.bands
        while True:
            try:
                return self._pixel_sums(model, frame, bands, grad_image, count, texture, transmittance_gradient)
            except MemoryLimitError:
                has_room = frame.lists.pairs <= frame.lists.capacity  # otherwise, bands would not be of this frame
                if not (has_room and self._halve_bands(frame.camera)):
                    raise
                bands = self._split(frame.camera)

    def _pixel_sums(
        self,
        model: DeviceModel,
        frame: Frame,
        bands: list[Band],
        grad_image: Array,
        count: int,
        texture: Array | None,
        transmittance_gradient: Array | None,
    ) -> PixelSums:
        lists, pixel_sums = frame.lists, self.workspace.array("pixel_sums", (count, model.gaussians.capacity))
        changes = {
            "camera": frame.camera.array,
            "grad_image": grad_image,
            "texture": texture or frame.transmittance,  # the kernel reads it only with texture sums
            "behind": transmittance_gradient or frame.transmittance,
        }
        is_summed = len(bands) > 1 or frame.content == "inverse_depth"
        for i, band in enumerate(bands):
            if len(bands) > 1:
                _, lists = self._list_band(frame.model, frame.camera, band, frame.content)
                if self._lanes == 1:  # the states in front of buckets are those of the last band
                    frame_inputs = frame.model, frame.camera, band, self._black, frame.content, frame.splats, lists
                    self._blend_band(*frame_inputs, prefix="second ")
            pairs = lists.capacity if len(bands) == 1 else lists.pairs  # their number is known only in bands
            changes["pair_sums"] = self.workspace.array("pair_sums", (pairs, RECORD), slack=1.0)
            flags = {"is_summed": is_summed, "is_first": i == 0, "has_behind": bool(transmittance_gradient)}
            self._sum_band(model, frame, band, lists, pixel_sums, changes, **flags)
        pair_sums, gaussians = changes["pair_sums"], model.gaussians
        arguments = {"pair_sums": pair_sums, "first_pair": lists.first_pair, "tile_count": lists.tile_count}
        key = "sum records", gaussians.key, count, pair_sums.buffer.serial, lists.key
        inputs = pair_sums, lists, gaussians, pixel_sums, 0
        launch = partial(self.workspace.plans.run, key, {}, sum_records, *inputs)
        return PixelSums(pixel_sums, arguments, None if is_summed else launch)

    def _sum_band(
        self,
        model: DeviceModel,
        frame: Frame,
        band: Band,
        lists: TileLists,
        pixel_sums: Array,
        changes: dict[str, Any],
        **flags: bool,
    ) -> None:
        """Compute the records of a band's pairs; add their sums to `pixel_sums`, or overwrite it in the first band."""

        def launch() -> None:
            behind = {"GRAD_BEHIND": 1} if flags["has_behind"] else {}
            arguments: dict[str, Any] = self._buckets(lists, frame.camera, frame.content)
            if arguments:
                arguments["end_tile"] = band.first_tile + band.tiles_inside
            for first_tile, groups in self._launches(band, lists.capacity // BUCKET if arguments else 0):
                self._blend(frame.content, **sum_defines(pixel_sums), **model.defines, **behind).blend_backward(
                    groups=groups,
                    tile_offset=lists.tile_offset,
                    tile_pairs=lists.tile_pairs,
                    pair_splat=lists.pair_splat,
                    splats=frame.splats,
                    image=frame.image,
                    tile_last=frame.tile_last,
                    first_tile=first_tile,
                    **arguments,
                    **changes,
                )
            pair_sums, accumulate = changes["pair_sums"], int(not flags["is_first"])
            if flags["is_summed"]:
                sum_records(pair_sums, lists, model.gaussians, pixel_sums, accumulate)
            if frame.content == "inverse_depth":
                sum_inverse_depths(self.workspace, pair_sums, lists, model.gaussians, accumulate)

        size = frame.camera.size, band, pixel_sums.shape[0], self.budget.tiles, lists.capacity
        key = "backward", model.key, frame.key, frame.content, lists.key, size, *flags.values()
        self.workspace.plans.run(key, changes, launch)

    def gradients(self, model: DeviceModel, frame: Frame, pixel_sums: Array) -> GaussianGradients:
        """Return the gradients of the loss with respect to all parameters of the model; valid until the next call."""
        if self._gradients is None or not self._gradients.fits(model.gaussians):
            self._gradients = GaussianGradients(model.gaussians)
        gradients = self._gradients
        arrays = {"splats": frame.splats, "pixel_sums": pixel_sums, **gradients.arguments()}

        def launch() -> None:
            self.device.program("project.cl", **model.defines).project_backward(
                items=-(-model.gaussians.count // self._lanes),
                **projection_arguments(frame.model, frame.camera),
                **arrays,
            )

        key = "gradients", frame.model.key, *(array.buffer.serial for array in arrays.values())
        self.workspace.plans.run(key, {"camera": frame.camera.array}, launch)
        if frame.content == "inverse_depth":
            add_inverse_depth_gradient(self.workspace, frame.camera, frame.splats, gradients["means"])
        backpropagate_motion(model, frame.camera, gradients)
        return gradients

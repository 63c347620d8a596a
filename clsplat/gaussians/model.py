"""Define a model on the host: its NumPy arrays, in the units of model files, and its rendering parameters."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.files import METRICS, is_inside
from clsplat.core.reading import read_json
from clsplat.formats import splats as columns
from clsplat.formats.ply import MAX_NUMBER
from clsplat.formats.sog_quantize import is_before_gap
from clsplat.formats.splats import (
    APPLY_TRANSFORM,
    MAX_DEGREE,
    MAX_EXPONENT,
    MAX_LOG,
    MAX_VALUE,
    MIP_VARIANCE,
    PARAMETERS,
    SH_C0,
    VARIANCE,
    ReadOptions,
    SplatFile,
    WriteOptions,
    columns_to_sh_degree,
    default_near,
    inverse_opacities,
    not_finite,
    opacities,
    sh_coefficients,
    transform,
)
from clsplat.formats.table import model_file, read, write, writing_format
from clsplat.gaussians.gaussians import DeviceModel, Gaussians
from clsplat.gaussians.motion import evaluate_at, transform_motion
from clsplat.gaussians.sky import WITHOUT_SKY, Sky, read_sky_file, without_sky_path, write_sky_file
from clsplat.opencl.device import Device
from clsplat.scene.quality import near_plane
from clsplat.scene.scene import Scene, choose_origin_near, format_position

# The rendering parameters of a model, as stored in its file.


@dataclass(frozen=True)
class Rendering:
    """The rendering parameters of a model."""

    near: float = 0.0  # scene units; nearer Gaussians are not rendered; 0: chosen for the scene or model
    screen_variance: float = VARIANCE  # px², added to every splat
    compensate: float = 0.0  # 1: opacities are reduced to conserve energy under that variance
    background: Literal["black", "white"] | None = None  # None: the background of the scene
    alpha: Literal["transparency", "mask"] = "transparency"  # meaning of the alpha channel of its photos
    notes: Mapping[str, Any] = field(default_factory=dict)  # other values in the file
    pixel_box: float = 0.0  # 1: splats are integrated over the pixel's box; screen_variance is then for viewers

    @classmethod
    def from_comment(cls, comment: Mapping[str, Any], mode: str) -> "Rendering":
        """Read the rendering parameters from a file's comment; the defaults are those of 3DGS or Mip-Splatting."""
        mip = {"screen_variance": MIP_VARIANCE, "compensate": 1.0} if mode == "mip" else {}
        names = ("near", "screen_variance", "compensate", "pixel_box")
        values = {name: float(comment[name]) for name in names if isinstance(comment.get(name), int | float)}
        return cls(
            **{**mip, **values},
            background=comment["background"] if comment.get("background") in ("black", "white") else None,
            alpha="mask" if comment.get("alpha") == "mask" else "transparency",
            notes=dict(comment),
        )

    def comment(self) -> dict[str, Any]:
        """Return the rendering parameters as the dictionary in a model file's comment."""
        values = {"screen_variance": self.screen_variance, "compensate": self.compensate}
        values = {"near": self.near, **values} if self.near else values
        optional: dict[str, Any] = {"background": self.background} if self.background else {}
        if self.pixel_box or "pixel_box" in self.notes:  # leaves files of other models unchanged
            optional["pixel_box"] = self.pixel_box
        return {**self.notes, **values, **optional, "alpha": self.alpha}


# Paths of models.

MODEL = "point_cloud.ply"  # default in a run folder


def model_path(path: Path) -> Path:
    """Return the model file of a path: its meta.json for a SOG folder, and its model for a run folder."""
    file = model_file(path)
    return run_model_path(file) if file.is_dir() else file


def run_model_path(folder: Path) -> Path:
    """Return the model file of a run folder: the last export, preferably the one without sky Gaussians."""
    file = exported_model_path(folder)
    return scene_file if (scene_file := without_sky_path(file)).is_file() else file


def exported_model_path(path: Path) -> Path:
    """Return the last export of a run folder, as named in its metrics.json; return other paths unchanged."""
    return run_output(path, "export", MODEL) if model_file(path).is_dir() else path


def run_output(folder: Path, stage: str, default: str) -> Path:
    """Return the output file of a run's last stage with this name, as listed in metrics.json, or the default file."""
    try:
        name = read_json(folder / METRICS)["files"][stage]
    except (DataError, KeyError, TypeError):  # the run has not finished
        name = default
    return folder / (name if isinstance(name, str) and is_inside(name) else default)


def raw_model_path(file: Path) -> Path:
    """Return the PLY next to a run's model that stores the world filter separately, or the model if there is none."""
    raw_path = file.with_name(f"{file.stem.removesuffix(WITHOUT_SKY)}_raw.ply")
    return raw_path if raw_path.is_file() else file


Floats = NDArray[np.float32]
WIDTHS = {  # allowed numbers of columns
    **{"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacity": (1,), "sh_base": (3,)},
    "sh_rest": tuple(3 * (sh_coefficients(degree) - 1) for degree in range(MAX_DEGREE + 1)),
    "filter_variance": (1,),
    columns.MOTION: tuple(columns.WIDTHS),
}
DEFAULT_RENDERING = Rendering()
MIN_LOGIT = -80.0  # of an opacity that the filter reduces to nothing; smallest value that kernels handle


@dataclass(frozen=True, eq=False)
class Model:
    """N Gaussians before activation, as float32 arrays with the names used in pipelines, kernels, and checkpoints.

    The arrays are copied.  Raises ValueError, with the name of the table, if shapes do not match.
    """

    means: Floats  # [N, 3] scene units
    quats: Floats  # [N, 4] (w, x, y, z), unnormalized
    log_scales: Floats  # [N, 3] log of scene units
    logit_opacity: Floats  # [N, 1]
    sh_base: Floats  # [N, 3] band 0
    sh_rest: Floats  # [N, (K-1)*3] the other bands, coefficient-major
    filter_variance: Floats | None = None  # [N, 1] scene units², a world filter that is not baked into the scales
    rendering: Rendering = DEFAULT_RENDERING
    sky: Sky | None = None  # behind the Gaussians, instead of a background color
    motion: Floats | None = None  # [N, 5 or more] of moving Gaussians, see clsplat/formats/splats.py
    origin: NDArray[np.floating] = field(default_factory=lambda: np.zeros(3))  # [3] world coordinates of zero

    def __post_init__(self) -> None:
        count = len(self.means)
        for name, table in self.tables().items():
            array = np.array(table, np.float32, order="C")
            if array.shape not in [(count, width) for width in WIDTHS[name]]:
                widths = " or ".join(map(str, WIDTHS[name]))
                raise ValueError(f"{name} has shape {array.shape}; expected ({count}, {widths})")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "origin", np.array(self.origin, np.float64).reshape(3))

    def __len__(self) -> int:
        return len(self.means)

    def upload(self, device: Device) -> DeviceModel:
        """Copy the model to a device for rendering."""
        rendering = self.rendering
        gaussians = Gaussians(device, self.tables())
        screen_filter = rendering.screen_variance, rendering.compensate, rendering.pixel_box
        sky = self.sky.upload(device) if self.sky else None
        return DeviceModel(gaussians, self.sh_degree, self.near, *screen_filter, sky=sky)

    def tables(self) -> dict[str, Floats]:
        """Return the arrays by name, including filter_variance and motion if present."""
        tables = {name: getattr(self, name) for name in (*PARAMETERS, "filter_variance", columns.MOTION)}
        return {name: table for name, table in tables.items() if table is not None}

    def at(self, time: float) -> "Model":
        """Return the static model of the Gaussians visible at a time from 0 to 1; a static model is returned unchanged.

        Raises ValueError for other times, and DataError if some positions are not finite.
        """
        if not 0 <= time <= 1:
            raise ValueError(f"the time is {time:g}; expected a number from 0 (start) to 1 (end)")
        if self.motion is None:
            return self
        tables: dict[str, Any] = dict(evaluate_at(self.tables(), time))
        if invalid := int(not_finite(tables).sum()):
            raise DataError(
                f"at time {time:g}, {invalid:,} Gaussians have no finite position; keep speeds below {MAX_VALUE:g}, or "
                "drop the faster Gaussians with `clsplat convert MODEL OTHER.ply`"
            )
        return replace(self, **tables, motion=None)

    @property
    def sh_degree(self) -> int:
        """The degree of the spherical harmonics."""
        return columns_to_sh_degree(self.sh_rest.shape[1])

    @property
    def is_scene(self) -> NDArray[np.bool_]:
        """A mask, [N], of the Gaussians that are not sky."""
        if self.rendering.notes.get("sky") != "splats":
            return np.ones(len(self), np.bool_)
        means = self.means.astype(np.float64)
        return is_before_gap(np.linalg.norm(means - np.median(means, axis=0), axis=1))

    @property
    def scene_means(self) -> Floats:
        """The means, [N, 3], without those of sky Gaussians."""
        return self.means[self.is_scene]

    @property
    def near(self) -> float:
        """The near plane in scene units: `rendering.near`, or a fraction of the model's size if that is 0."""
        return self.rendering.near or default_near(self.means)

    @property
    def scales(self) -> Floats:
        """Standard deviations along the axes, [N, 3] scene units."""
        return np.exp(np.minimum(self.log_scales, MAX_LOG))

    @property
    def opacities(self) -> Floats:
        """Opacities in (0, 1), [N]."""
        return opacities(self.logit_opacity[:, 0]).astype(np.float32)

    @property
    def colors(self) -> Floats:
        """Colors of band 0, [N, 3]; values in [0, 1] can be displayed."""
        return np.asarray(self.sh_base * SH_C0 + 0.5, np.float32)

    def __getitem__(self, index: Any) -> "Model":
        """Select Gaussians by a mask [N], an array of indices, a slice, or one index."""
        tables: dict[str, Any] = {name: np.atleast_2d(table[index]) for name, table in self.tables().items()}
        return replace(self, **tables)

    def transformed(
        self, scale: float = 1.0, rotation: NDArray[np.floating] | None = None, translation: Any = (0, 0, 0)
    ) -> "Model":
        """Return the model after x -> scale · rotation x + translation; view-dependent colors rotate with it.

        rotation: [3, 3]; translation: [3] scene units, added to the origin if the model has one, else to the means; the
        result has an origin if float32 is too coarse for the new means.
        Raises ValueError for a matrix that is not a rotation, and if the result does not fit in a model file.
        """
        matrix = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
        if np.shape(translation) != (3,):
            raise ValueError(f"the translation has shape {np.shape(translation)}; expected (3,)")
        origin, shift = self.origin, np.asarray(translation, np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            if origin.any():
                origin, shift = scale * matrix @ origin + shift, np.zeros(3)
            results: dict[str, Any] = transform(self.tables(), scale, matrix, shift)
            means = results["means"]
            if not origin.any() and np.isfinite(means).all() and not is_float32_precise(means, results["log_scales"]):
                origin = choose_origin_near(np.median(means, axis=0), means)
                results["means"] = means - origin
            if self.motion is not None:
                results["motion"] = transform_motion(self.motion, scale, matrix)
            if self.filter_variance is not None:
                results["filter_variance"] = self.filter_variance * scale**2
            tables = {name: table.astype(np.float32) for name, table in results.items()}
        near = self.rendering.near * scale
        if near >= MAX_NUMBER or (not_finite({**self.tables(), **tables}) & ~not_finite(self.tables())).any():
            raise ValueError("the result does not fit in a model file; use a smaller scale and translation")
        sky = self.sky.rotated(matrix) if self.sky and rotation is not None else self.sky
        return replace(self, **tables, rendering=replace(self.rendering, near=near), sky=sky, origin=origin)

    def in_scene(self, scene: Scene) -> "Model":
        """Return the model relative to the scene's origin, with the scene's near plane unless the model has one."""
        model = self.with_origin(scene.origin)
        if model.rendering.near:
            return model
        return replace(model, rendering=replace(model.rendering, near=near_plane(scene)))

    def with_origin(self, origin: NDArray[np.floating]) -> "Model":
        """Return the model with its means relative to another origin, [3] world coordinates.

        Many formats and programs lose the origin.  If a model has none, and its means are closer to zero than to
        `origin`, they are assumed to be relative to `origin` already.
        """
        if not self.origin.any() and np.any(origin) and len(self):
            center = np.median(self.means, axis=0).astype(np.float64)
            if np.linalg.norm(center) < np.linalg.norm(center - origin):
                LOG.info("the model has no origin; its means are assumed to be relative to %s", format_position(origin))
                return replace(self, origin=origin)
        shift = self.origin - origin
        return replace(self, means=self.means + shift, origin=origin) if shift.any() else self

    def baked(self) -> "Model":
        """Return the model with the world filter baked into scales and opacities (Yu et al. 2024, eq. 9).

        The result looks the same in viewers without that filter.
        """
        if self.filter_variance is None:
            return self
        scale2 = np.exp(np.clip(2 * self.log_scales.astype(np.float64), -MAX_EXPONENT, MAX_EXPONENT))
        filtered_scale2 = scale2 + self.filter_variance.astype(np.float64)
        opacity = np.sqrt(np.prod(scale2 / filtered_scale2, axis=1, keepdims=True))
        opacity /= inverse_opacities(self.logit_opacity)
        with np.errstate(divide="ignore"):
            logit = np.log(opacity) - np.log1p(-opacity)
        log_scales = (0.5 * np.log(filtered_scale2)).astype(np.float32)
        logits = np.clip(logit, MIN_LOGIT, -MIN_LOGIT).astype(np.float32)
        return replace(self, log_scales=log_scales, logit_opacity=logits, filter_variance=None)

    def save(self, path: str | Path, options: WriteOptions | None = None) -> str:
        """Write a file in the format that its name implies: .ply, .spz, .sog, .glb, and others (docs/formats.md).

        A PLY stores a world filter as the property `filter_3D`; for other formats, it is baked.  A sky is written next
        to the model as NAME_sky.json, which contains the SHA-256 of the model file, so that no other model uses it.
        Returns the SHA-256 of the file, or of meta.json for a SOG folder.
        Raises ConfigError for an unknown extension or world coordinates that the format cannot store, and OutputError
        if the file cannot be written.
        """
        model = self if writing_format(Path(path)).keeps_all else self.baked()
        splats = model.to_splat_file() if not (options and options.world) else model._in_world(Path(path))
        digest = write(Path(path), splats, options)
        write_sky_file(self.sky, Path(path), digest)
        return digest

    def _in_world(self, path: Path) -> SplatFile:
        """Return the file content in world coordinates.  The means are float64 if float32 is too coarse."""
        if not self.origin.any():
            LOG.warning("%s: the model has no origin; its coordinates are written unchanged", path)
            return self.to_splat_file()
        means: Any = self.means + self.origin
        if is_float32_precise(means, self.log_scales):
            means = means.astype(np.float32)
        elif writing_format(path).keeps_all:
            LOG.info("%s: x, y, and z are written as doubles, since floats are too coarse for world coordinates", path)
        else:
            raise ConfigError(
                f"{path}: world coordinates around {format_position(self.origin)} exceed the precision of this format; "
                "write a .ply, or omit --world: GLB and OpenUSD store the origin in their node"
            )
        local = replace(self, origin=np.zeros(3)).to_splat_file()
        return replace(local, parameters={**local.parameters, "means": means})

    def to_splat_file(self) -> SplatFile:
        """Return the content of a model file; arrays are shared, not copied."""
        origin = {"origin": self.origin.tolist()} if self.origin.any() else {}
        mode = "mip" if self.rendering.compensate else "default"
        return SplatFile(self.tables(), {**self.rendering.comment(), **origin}, mode)

    def __repr__(self) -> str:
        suffix = ", moving" if self.motion is not None else ""
        return f"Model({len(self):,} Gaussians{suffix}, SH degree {self.sh_degree})"

    def _repr_html_(self) -> str:
        from clsplat.core.page import render_summary

        low, high = (self.means.min(axis=0), self.means.max(axis=0)) if len(self) else (np.zeros(3), np.zeros(3))
        rows = {
            "Gaussians": f"{len(self):,}",
            "spherical harmonics": f"degree {self.sh_degree}",
            "box, scene units": f"({', '.join(f'{v:.3g}' for v in low)}) to ({', '.join(f'{v:.3g}' for v in high)})",
            "median scale": f"{float(np.median(self.scales)):.3g} scene units" if len(self) else "–",
            "median opacity": f"{float(np.median(self.opacities)):.3g}" if len(self) else "–",
            **({"origin, world coordinates": format_position(self.origin)} if self.origin.any() else {}),
            "size as PLY": f"{sum(table.nbytes for table in self.tables().values()) / 2**20:,.1f} MiB",
        }
        return render_summary(rows)


LOG = logging.getLogger("clsplat")
MAX_SPACING = 0.05  # of positions, relative to the median scale; a larger spacing becomes visible


def is_float32_precise(means: NDArray[np.floating], log_scales: Floats) -> bool:
    """Return whether float32 is precise enough for the means, [N, 3], of Gaussians with these log scales.

    Also returns True for means beyond MAX_NUMBER, which are not valid coordinates.
    """
    if not len(means):
        return True
    magnitude = np.abs(np.median(means, axis=0)).max()
    if magnitude >= MAX_NUMBER:
        return True
    spacing = np.spacing(np.float32(magnitude))
    return bool(spacing <= MAX_SPACING * np.exp(min(float(np.median(log_scales)), MAX_LOG)))


def load(path: str | Path, options: ReadOptions | None = None) -> Model:
    """Read a model file of any format (docs/formats.md), or the model of a run folder.

    If the file has no origin and float32 is not precise enough for its means, an origin near them is chosen.
    Raises DataError if the file is missing, damaged, or not a splat model.
    """
    path = Path(path)
    file = read(model_path(path), options)
    sky = read_sky_file(model_path(path), file.rendering.get("sky") == "directions" and not (options and options.quiet))
    comment, tables = dict(file.rendering), dict[str, Any](file.parameters)
    origin: NDArray[np.floating] = np.array(comment.pop("origin", np.zeros(3)), np.float64)
    finite_means = tables["means"][~not_finite({"means": tables["means"]})]
    if not origin.any() and not is_float32_precise(finite_means, tables["log_scales"]):
        finite_means = finite_means.astype(np.float64)
        origin = choose_origin_near(np.median(finite_means, axis=0), finite_means)
        tables["means"] = np.asarray(tables["means"] - origin, np.float32)
    model = Model(**tables, rendering=Rendering.from_comment(comment, file.mode), sky=sky)
    if file.placement is not None:
        scale = float(np.cbrt(np.linalg.det(file.placement[:3, :3])))
        rotation, shift = file.placement[:3, :3] / (scale or 1), file.placement[:3, 3]
        origin = scale * rotation @ origin
        if not is_float32_precise(shift[None], model.log_scales + np.log(abs(scale) or 1)):
            origin, shift = origin + shift, np.zeros(3)
        try:
            model = model.transformed(scale, rotation, shift)
        except ValueError as error:
            fault = f"the transform of a node is not supported ({error})"
            raise DataError(f"{path}: {fault}; {APPLY_TRANSFORM}") from error
    return replace(model, origin=origin) if origin.any() else model

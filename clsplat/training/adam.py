"""Optimize the parameters of Gaussians with Adam, with one learning rate per parameter, and average them over steps."""

from collections.abc import Collection, Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import Decay, NonNegative, Schedule, at_step, divide, explain_schedule
from clsplat.core.settings import Settings
from clsplat.formats.splats import MOTION, PARAMETERS, sh_coefficients
from clsplat.gaussians.deferred import DeferredHarmonics
from clsplat.gaussians.gaussians import DeviceModel, Gaussians
from clsplat.gaussians.sh_offload import slot_arguments, slot_defines
from clsplat.gaussians.structs import DeferredUpdates, GaussianGradients, moment_tables
from clsplat.opencl.device import Array, constants
from clsplat.opencl.plan import Plans
from clsplat.render.rasterizer import Frame, PixelSums, projection_arguments, sum_defines
from clsplat.training.motion import MotionRates, update_motion


class FullSizeDecay(Settings):
    """Keep the initial rate until training uses full-size photographs, then decay exponentially (DashGaussian, Chen et
    al. 2025)."""

    step_keys: ClassVar[frozenset[str]] = frozenset({"until"})

    start: Literal["full_size"]
    """`full_size`: the decay starts at the first step with full-size photos."""
    until: Annotated[int, Field(gt=0)]
    """Global step at which the rate reaches `final`."""
    initial: Annotated[float, Field(gt=0)]
    """Rate before the decay."""
    final: Annotated[float, Field(gt=0)]
    """Rate after the decay."""

    def from_step(self, step: int) -> Decay:
        """Return the decay that starts at a global step."""
        start = min(step, self.until - 1)
        return Decay(initial=self.initial, final=self.final, start=start, over=self.until - start)


def _scale_rate(rate: FullSizeDecay | Schedule, factor: float) -> FullSizeDecay | Schedule:
    if isinstance(rate, FullSizeDecay):
        return rate.model_copy(update={"initial": rate.initial * factor, "final": rate.final * factor})
    return divide(rate, 1 / factor)


class Rates(Settings):
    """Learning rates of the parameters, which may be scheduled."""

    means: Annotated[
        FullSizeDecay | NonNegative, explain_schedule(", or {initial, final, until, start: full_size}")
    ] = Decay(initial=1.6e-4, final=1.6e-6, over=30_000)
    """Learning rate of the means, in units of the scene's extent."""
    quats: NonNegative = 1.0e-3
    """Learning rate of the quaternions."""
    log_scales: NonNegative = 5.0e-3
    """Learning rate of the logarithms of the scales."""
    logit_opacity: NonNegative = 5.0e-2
    """Learning rate of the logits of the opacities."""
    sh_base: NonNegative = 2.5e-3
    """Learning rate of the spherical harmonics of degree 0."""
    sh_rest: NonNegative = 1.25e-4
    """Learning rate of the higher degrees, which cost the most time; at 0, they and their moments are not updated."""
    motion: MotionRates = MotionRates()
    """Learning rates of the motion, if Gaussians move."""

    def scale(self, factor: float) -> "Rates":
        """Return all rates multiplied by a factor."""
        values = {name: getattr(self, name) for name in PARAMETERS}
        scaled_values = {name: _scale_rate(value, factor) for name, value in values.items()}
        return self.model_copy(update={**scaled_values, "motion": self.motion.scale(factor)})

    def resolve(self, full_size_step: int) -> "Rates":
        """Return rates that depend only on the step.  full_size_step: the first global step with full-size photos."""
        if not isinstance(self.means, FullSizeDecay):
            return self
        return self.model_copy(update={"means": self.means.from_step(full_size_step)})

    def at(self, step: int, extent: float) -> dict[str, float]:
        """Return the rates at a global step, keyed by parameter or motion field.

        extent: extent of the scene, scene units.  Raises ConfigError if `resolve` must be called first.
        """
        if isinstance(self.means, FullSizeDecay):
            raise ConfigError(
                "a rate with `start: full_size` needs the first step at full size; use the rates that `resolve(step)` "
                "returns"
            )
        rates = {name: at_step(getattr(self, name), step) for name in PARAMETERS}
        return {**rates, "means": rates["means"] * extent, **self.motion.at(step, extent)}


Rows = Literal["all", "seen", "deferred"]  # rows to update; deferred: all rows, some of them later
_EVERY = {"all": 0xFFFFFFFF, "seen": 0, "deferred": 0xFFFFFFFF}
_FACTORS = {name: (f"{name}_rate", f"{name}_correction2") for name in PARAMETERS}  # kernel arguments
_UNDRAWN = {"all": 0xFFFFFFFF, "seen": 0xFFFFFFFF, "deferred": 0}
_MEAN2D, _ABS_NORM = (int(constants("adam.cl")[f"OUTPUT_{name}"]) for name in ("MEAN2D", "ABS_NORM"))


class Adam:
    """Adam (Kingma and Ba 2015), with moments in tables next to the parameters and one update count per parameter.

    With `rows="seen"`, a Gaussian that is culled in the view (its alpha is below 1/255 in all pixels) keeps its
    parameters and moments, even if penalties have gradients.  Bias correction uses the update count of the parameter,
    although a row may have had fewer updates; published kernels (Taming 3DGS) omit the correction.

    With `rows="deferred"`, `sh_rest` of a Gaussian is not updated until a view sees it; results are bit-identical to
    those of `all`.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians = gaussians
        self._plans = Plans(gaussians.device)
        self.updates = dict.fromkeys(gaussians.trained, 0)
        gaussians.device.program("adam.cl")  # built before the first step
        self._lanes = int(gaussians.device.tuning["LANES"])
        self._vectors = int(gaussians.device.tuning["VECTORS"])
        self._grad_mean2d: Array | None = None  # allocated at first use
        self._beta1, self._beta2 = constants("adam.h")["BETA1"], constants("adam.h")["BETA2"]
        for name in gaussians.trained:
            for moment in moment_tables(name):
                gaussians.add(moment, gaussians.tables[name].components, zero_fresh=True)

    def update(
        self,
        model: DeviceModel,
        frame: Frame,
        pixel_sums: PixelSums | Array,
        rates: dict[str, float],
        rows: Rows = "all",
        statistics: Mapping[str, Any] | None = None,
    ) -> Array:
        """Update all parameters from the frame's sums over pixels, [PIXEL_SUMS, S].

        Returns the gradient of the projected means, [2, S] px⁻¹, which is valid until the next update.
        statistics: the result of `SplatStats.update_arguments`, to add the view to these statistics; without it, only
        this gradient is written.  Nothing changes on the device if the frame has no room for its pairs
        (`Rasterizer.is_complete`).
        """
        gaussians, rows, grad_mean2d = self.gaussians, self.effective_rows(rows), self._mean2d()
        sums = {"pixel_sums": pixel_sums, "has_pairs": 0} if isinstance(pixel_sums, Array) else pixel_sums.arguments()
        unused = {"first_pair": frame.depth_key, "tile_count": frame.depth_key, "pair_sums": grad_mean2d}
        changes: dict[str, Any] = {
            "camera": frame.camera.array,
            "pair_count": frame.lists.pair_count,
            **{name: sums.pop(name, array) for name, array in unused.items()},
        }
        arrays = {"splats": frame.splats, "grad_mean2d": grad_mean2d, "radius": frame.radius, **sums}
        arrays |= statistics or {"seen": grad_mean2d, "norms": grad_mean2d, "outputs": _MEAN2D}
        numbers = {name: arrays.pop(name) for name in ("has_pairs", "outputs")}
        defines = sum_defines(arrays["pixel_sums"]) if numbers["outputs"] & _ABS_NORM else {}
        deferred = self._prepare_deferred(rows, model, rates)
        for name, (rate_name, correction_name) in _FACTORS.items():
            changes[rate_name], changes[correction_name] = self._count_update(name, rates)
        changes["sh_rest_degree"] = model.degree if rates["sh_rest"] else 0
        changes["half_width"], changes["half_height"] = frame.camera.width / 2, frame.camera.height / 2

        def launch() -> None:
            tables: dict[str, Any] = {
                f"{name}_moment{number}": gaussians.tables[table].array
                for name in PARAMETERS
                for number, table in enumerate(moment_tables(name), 1)
            }
            gaussians.device.program("adam.cl", **defines, **model.defines).update_gaussians(
                items=-(-gaussians.count // (self._lanes * self._vectors)),
                **{**projection_arguments(model, frame.camera), **arrays, **numbers, **changes},
                **tables,
                sh_base=gaussians["sh_base"],
                every=_EVERY[rows],
                undrawn=_UNDRAWN[rows],
            )

        key = "update", model.key, rows, *numbers.values(), *(array.buffer.serial for array in arrays.values())
        self._plans.run(key, changes, launch)
        self._record_sh(deferred, frame, changes["sh_rest_rate"], changes["sh_rest_correction2"])
        return grad_mean2d

    def step(
        self,
        model: DeviceModel,
        frame: Frame,
        gradients: GaussianGradients,
        rates: dict[str, float],
        frozen: Collection[str] = (),
        rows: Rows = "all",
    ) -> None:
        """Update all parameters except those in `frozen` from gradients in memory.

        Harmonics above the active degree are skipped, because their gradients and moments are zero.
        """
        gaussians, rows = self.gaussians, self.effective_rows(rows)
        deferred = None if "sh_rest" in frozen else self._prepare_deferred(rows, model, rates)
        for name in PARAMETERS:
            if name in frozen or (name == "sh_rest" and not rates[name]):
                continue
            rate, correction2 = self._count_update(name, rates)
            inputs = {"gradient": gradients[name], "depth_key": frame.depth_key}
            self._step_table(name, model.degree, rows, inputs, {"rate": rate, "correction2": correction2})
            if name == "sh_rest":
                self._record_sh(deferred, frame, rate, correction2)
        if gaussians.is_moving and MOTION not in frozen:
            self.updates[MOTION] += 1
            update_motion(gaussians, gradients, frame.depth_key, rates, self.updates[MOTION], _EVERY[rows])

    def _step_table(self, name: str, degree: int, rows: Rows, inputs: dict[str, Any], factors: dict[str, Any]) -> None:
        gaussians, is_sh_rest = self.gaussians, name == "sh_rest"

        def launch() -> None:
            values, moment1, moment2 = (gaussians.tables[table].array for table in (name, *moment_tables(name)))
            components = 3 * (sh_coefficients(degree) - 1) if is_sh_rest else gaussians.tables[name].components
            gaussians.device.program("adam.cl", **(slot_defines(gaussians) if is_sh_rest else {})).adam_step(
                items=(-(-gaussians.count // self._lanes), components),
                values=values,
                moment1=moment1,
                moment2=moment2,
                **inputs,
                **factors,
                every=_EVERY[rows],
                undrawn=_UNDRAWN[rows] if is_sh_rest else _UNDRAWN["all"],
                **slot_arguments(gaussians),
                stride=gaussians.capacity,
                count=gaussians.count,
            )

        key = "step", name, degree, gaussians.key, rows, *(array.buffer.serial for array in inputs.values())
        self._plans.run(key, factors, launch)

    def _prepare_deferred(self, rows: Rows, model: DeviceModel, rates: dict[str, float]) -> DeferredUpdates | None:
        """Return the deferred updates of `sh_rest`, or None if none of its updates are deferred."""
        gaussians = self.gaussians
        if rows != "deferred":
            if gaussians.deferred:
                gaussians.deferred.flush()
            return None
        if model.degree == 0 or not rates["sh_rest"]:
            return None
        gaussians.deferred = gaussians.deferred or DeferredHarmonics(gaussians)
        gaussians.deferred.prepare(model.degree)
        return gaussians.deferred

    def _mean2d(self) -> Array:
        """Return the array for the gradient of the projected means, [2, S]; allocate it again if an edit changed S."""
        shape = (2, self.gaussians.capacity)
        if self._grad_mean2d is None or self._grad_mean2d.shape != shape:
            self._grad_mean2d = None  # frees the old array before the new one is allocated
            self._grad_mean2d = self.gaussians.device.empty(shape)
        return self._grad_mean2d

    def effective_rows(self, rows: Rows) -> Rows:
        """Return the rows to update; updates of offloaded harmonics are always deferred until a view sees them."""
        return "deferred" if rows == "all" and self.gaussians.on_host else rows

    def _record_sh(self, deferred: DeferredUpdates | None, frame: Frame, rate: float, correction2: float) -> None:
        """Record this update of `sh_rest`, and start the download of offloaded harmonics."""
        if deferred:
            deferred.record(frame.depth_key, (rate, correction2))
        if self.gaussians.on_host:
            self.gaussians.on_host.start_download()

    def _count_update(self, name: str, rates: dict[str, float]) -> tuple[float, float]:
        """Count an update of a parameter; return its bias-corrected rate and the correction of its second moment."""
        self.updates[name] += name != "sh_rest" or rates[name] != 0  # see Rates.sh_rest
        updates = max(self.updates[name], 1)
        return rates[name] / (1 - self._beta1**updates), 1 / (1 - self._beta2**updates)

    def reset_moments(self, name: str) -> None:
        """Set both moments of a parameter to zero."""
        self.gaussians.zero_rows(moment_tables(name), np.arange(self.gaussians.count))


# The mean of the gradients of several views, in tables next to the parameters.

GRADIENT = "gradient/"  # prefix of parameter names
VIEWS = f"{GRADIENT}views"  # number of views in the mean of a row


def attach_gradients(gaussians: Gaussians) -> None:
    """Add tables for the mean gradients of several views, unless they exist."""
    if VIEWS not in gaussians.tables:
        _add_tables(gaussians, GRADIENT, VIEWS)


def add_gradients(gaussians: Gaussians, gradients: GaussianGradients) -> GaussianGradients:
    """Include the gradients of a view in the mean over views, and return the mean, which the next call overwrites."""
    _add_to_mean(gaussians, {name: gradients[name] for name in gaussians.trained}, GRADIENT, VIEWS)
    return gradients.replace({name: gaussians[GRADIENT + name] for name in gaussians.trained})


# The average of the parameters over steps, in tables next to them (Polyak and Juditsky 1992).

FOLDER = "average/"  # prefix of parameter names
NUMBER = f"{FOLDER}number"  # number of steps in the average of a row


def has_average(gaussians: Gaussians) -> bool:
    """Return whether the Gaussians have tables for averages."""
    return NUMBER in gaussians.tables


def attach_average(gaussians: Gaussians) -> None:
    """Add tables for averages, unless they exist.  The averages of new Gaussians start empty."""
    if not has_average(gaussians):
        _add_tables(gaussians, FOLDER, NUMBER)


def _add_tables(gaussians: Gaussians, prefix: str, counts: str) -> None:
    for name in gaussians.trained:
        gaussians.add(prefix + name, gaussians.tables[name].components, zero_fresh=True)
    gaussians.add(counts, 1, zero_fresh=True)


def add_to_average(gaussians: Gaussians) -> None:
    """Add the current parameters to their averages."""
    _add_to_mean(gaussians, {name: gaussians[name] for name in gaussians.trained}, FOLDER, NUMBER)


def _add_to_mean(gaussians: Gaussians, values: Mapping[str, Array], prefix: str, counts: str) -> None:
    """Add values, by parameter, to the means in the tables with this prefix.  counts: table of counts by row."""
    program, count = gaussians.device.program("average.cl"), gaussians.count
    for name, array in values.items():
        program.add_to_average(
            items=(count, gaussians.tables[name].components),
            values=array,
            average=gaussians[prefix + name],
            number=gaussians[counts],
            stride=gaussians.capacity,
            count=count,
        )
    program.count_step(items=count, number=gaussians[counts], count=count)


def apply_average(gaussians: Gaussians) -> None:
    """Replace parameters with their averages in all rows that have an average, and remove the tables of averages."""
    program = gaussians.device.program("average.cl")
    for name in gaussians.trained:
        program.take_average(
            items=(gaussians.count, gaussians.tables[name].components),
            values=gaussians[name],
            average=gaussians[FOLDER + name],
            number=gaussians[NUMBER],
            stride=gaussians.capacity,
            count=gaussians.count,
        )
    for table in (NUMBER, *(FOLDER + name for name in gaussians.trained)):
        del gaussians.tables[table]

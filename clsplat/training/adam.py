"""Adam on the tables of a Gaussians struct, with a learning rate for each."""

from collections.abc import Collection
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import Decay, NonNegative, Schedule, at_step, divide, explain_schedule
from clsplat.core.settings import Settings
from clsplat.formats.splats import MOTION, PARAMETERS, sh_coefficients
from clsplat.gaussians.deferred import Deferred
from clsplat.gaussians.gaussians import DeviceModel, Gaussians
from clsplat.gaussians.sh_offload import defines_of, slots_of
from clsplat.gaussians.structs import GaussianGradients, Waiting, moment_tables
from clsplat.opencl.device import Array, constants
from clsplat.render.rasterizer import Frame, shape_arguments
from clsplat.training.motion import MotionRates, update_motion


class FullSizeDecay(Settings):
    """The initial value as long as photographs have less than their full size, then an exponential decay (DashGaussian,
    Chen et al. 2025)."""

    step_keys: ClassVar[frozenset[str]] = frozenset({"until"})

    start: Literal["full_size"]
    """`full_size`: the first step at the full size of the photographs."""
    until: Annotated[int, Field(gt=0)]
    """Global step from which the value is the final one."""
    initial: Annotated[float, Field(gt=0)]
    """The value before the decay."""
    final: Annotated[float, Field(gt=0)]
    """The value after it."""

    def from_step(self, step: int) -> Decay:
        """Return the decay that begins at a global step."""
        start = min(step, self.until - 1)
        return Decay(initial=self.initial, final=self.final, start=start, over=self.until - start)


def _times(rate: FullSizeDecay | Schedule, factor: float) -> FullSizeDecay | Schedule:
    if isinstance(rate, FullSizeDecay):
        return rate.model_copy(update={"initial": rate.initial * factor, "final": rate.final * factor})
    return divide(rate, 1 / factor)


class Rates(Settings):
    """Learning rates by parameter, each by step.  Those of `means` are multiplied by the scene's extent."""

    means: Annotated[
        FullSizeDecay | NonNegative, explain_schedule(", or {initial, final, until, start: full_size}")
    ] = Decay(initial=1.6e-4, final=1.6e-6, over=30_000)
    """Of the means, as shares of the scene's extent."""
    quats: NonNegative = 1.0e-3
    """Of the quaternions."""
    log_scales: NonNegative = 5.0e-3
    """Of the logarithms of the scales."""
    logit_opacity: NonNegative = 5.0e-2
    """Of the logits of the opacities."""
    sh_base: NonNegative = 2.5e-3
    """Of band 0 of the spherical harmonics."""
    sh_rest: NonNegative = 1.25e-4
    """Of the other bands, which cost most; where it is 0 they are left alone, with their moments."""
    motion: MotionRates = MotionRates()
    """Of the motion, where Gaussians move."""

    def times(self, factor: float) -> "Rates":
        """Return all rates times a factor."""
        values = {name: getattr(self, name) for name in PARAMETERS}
        times = {name: _times(value, factor) for name, value in values.items()}
        return self.model_copy(update={**times, "motion": self.motion.times(factor)})

    def settled(self, full_size: int) -> "Rates":
        """Return rates by step alone; full_size: the first step at the full size of the photographs."""
        if not isinstance(self.means, FullSizeDecay):
            return self
        return self.model_copy(update={"means": self.means.from_step(full_size)})

    def at(self, step: int, extent: float) -> dict[str, float]:
        """Return the rates of a global step, by the names of PARAMETERS and of the fields of the motion.

        Raises ConfigError before they are settled.
        """
        if isinstance(self.means, FullSizeDecay):
            raise ConfigError(
                "a rate with `start: full_size` needs the step of the photographs' full size: expected what "
                "`settled(step)` returns"
            )
        rates = {name: at_step(getattr(self, name), step) for name in PARAMETERS}
        return {**rates, "means": rates["means"] * extent, **self.motion.at(step, extent)}


Rows = Literal["all", "seen", "deferred"]  # Gaussians that an update changes; deferred: all, some later
_EVERY = {"all": 0xFFFFFFFF, "seen": 0, "deferred": 0xFFFFFFFF}
_UNDRAWN = {"all": 0xFFFFFFFF, "seen": 0xFFFFFFFF, "deferred": 0}


class Adam:
    """Adam, with its moments in tables beside the parameters, and a number of updates for each parameter.

    Of the rows `seen`, one whose splat was culled in the view (it has no pixel within the photograph where it is not
    fainter than 1/255) keeps its parameters and both moments, whatever penalties give it.  The correction of the
    moments' bias counts the updates of a parameter, in `seen` too, where a row may have had fewer; published kernels
    (Taming 3DGS) leave the correction out.

    Of the rows `deferred`, `sh_rest` has its updates when a view sees it: the bits are those of `all`.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians = gaussians
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
        self, model: DeviceModel, frame: Frame, pixel_sums: Array, rates: dict[str, float], rows: Rows = "all"
    ) -> Array:
        """Update every parameter from the frame's sums over pixels, [PIXEL_SUMS, S].

        Returns the gradient of the projected means, [2, S] px⁻¹, valid until the next update.
        """
        gaussians = self.gaussians
        rows = self._possible(rows)
        grad_mean2d = self._mean2d()
        arguments: dict[str, Any] = {"sh_base": gaussians["sh_base"]}
        deferred = self._deferred(rows, model, rates)
        for name in PARAMETERS:
            moment1, moment2 = (gaussians.tables[table].array for table in moment_tables(name))
            rate, correction2 = self._factors(name, rates)
            arguments |= {f"{name}_moment1": moment1, f"{name}_moment2": moment2}
            arguments |= {f"{name}_rate": rate, f"{name}_correction2": correction2}
        program = gaussians.device.program("adam.cl", **model.defines)
        program.update_gaussians(
            items=-(-gaussians.count // (self._lanes * self._vectors)),
            **shape_arguments(model, frame.camera),
            **arguments,
            sh_rest_degree=model.degree if rates["sh_rest"] else 0,
            every=_EVERY[rows],
            undrawn=_UNDRAWN[rows],
            splats=frame.splats,
            pixel_sums=pixel_sums,
            grad_mean2d=grad_mean2d,
        )
        self._end(deferred, frame, arguments["sh_rest_rate"], arguments["sh_rest_correction2"])
        return grad_mean2d

    def step(
        self,
        model: DeviceModel,
        frame: Frame,
        gradients: GaussianGradients,
        rates: dict[str, float],
        without: Collection[str] = (),
        rows: Rows = "all",
    ) -> None:
        """Update every parameter but those named in `without` from gradients in memory; `frame`: of the view.

        Bands above the active SH degree are left out: their gradients and moments are zero.
        """
        gaussians, rows = self.gaussians, self._possible(rows)
        deferred = None if "sh_rest" in without else self._deferred(rows, model, rates)
        for name in PARAMETERS:
            if name in without or (name == "sh_rest" and not rates[name]):
                continue
            components = gaussians.tables[name].components
            if name == "sh_rest":
                components = 3 * (sh_coefficients(model.degree) - 1)
            values, moment1, moment2 = (gaussians.tables[table].array for table in (name, *moment_tables(name)))
            rate, correction2 = self._factors(name, rates)
            in_slots = defines_of(gaussians) if name == "sh_rest" else {}
            gaussians.device.program("adam.cl", **in_slots).adam_step(
                items=(-(-gaussians.count // self._lanes), components),
                values=values,
                gradient=gradients[name],
                moment1=moment1,
                moment2=moment2,
                depth_key=frame.depth_key,
                rate=rate,
                correction2=correction2,
                every=_EVERY[rows],
                undrawn=_UNDRAWN[rows] if name == "sh_rest" else _UNDRAWN["all"],
                **slots_of(gaussians),
                stride=gaussians.capacity,
                count=gaussians.count,
            )
            if name == "sh_rest":
                self._end(deferred, frame, rate, correction2)
        if gaussians.moves and MOTION not in without:
            self.updates[MOTION] += 1
            update_motion(gaussians, gradients, frame.depth_key, rates, self.updates[MOTION], _EVERY[rows])

    def _deferred(self, rows: Rows, model: DeviceModel, rates: dict[str, float]) -> Waiting | None:
        """What notes the next update of `sh_rest`; None where all rows have it at once, or none has it."""
        gaussians = self.gaussians
        if rows != "deferred":
            if gaussians.deferred:
                gaussians.deferred.flush()
            return None
        if model.degree == 0 or not rates["sh_rest"]:
            return None
        gaussians.deferred = gaussians.deferred or Deferred(gaussians)
        gaussians.deferred.before(model.degree)
        return gaussians.deferred

    def _mean2d(self) -> Array:
        """The array of the gradient of the projected means, of another size after edits."""
        shape = (2, self.gaussians.capacity)
        if self._grad_mean2d is None or self._grad_mean2d.shape != shape:
            self._grad_mean2d = None  # released before its successor is allocated
            self._grad_mean2d = self.gaussians.device.empty(shape)
        return self._grad_mean2d

    def _possible(self, rows: Rows) -> Rows:
        """Harmonics on the host are updated where a view sees them: of `all`, the others later."""
        return "deferred" if rows == "all" and self.gaussians.on_host else rows

    def _end(self, deferred: Waiting | None, frame: Frame, rate: float, correction2: float) -> None:
        """Note the update of `sh_rest` that the rows in the view have had."""
        if deferred:
            deferred.note(frame.depth_key, (rate, correction2))
        if self.gaussians.on_host:
            self.gaussians.on_host.begin_to_fetch()

    def _factors(self, name: str, rates: dict[str, float]) -> tuple[float, float]:
        """Rate and second factor of a parameter's next update, with the bias correction of the moments."""
        self.updates[name] += name != "sh_rest" or rates[name] != 0  # see Rates.sh_rest
        updates = max(self.updates[name], 1)
        return rates[name] / (1 - self._beta1**updates), 1 / (1 - self._beta2**updates)

    def forget(self, name: str) -> None:
        """Set the moments of one parameter to zero."""
        self.gaussians.zero_rows(moment_tables(name), np.arange(self.gaussians.count))


# The average of the parameters over steps, in tables beside them (Polyak and Juditsky 1992).

FOLDER = "average/"  # before the names of the parameters
NUMBER = f"{FOLDER}number"  # [1] of steps in the average of a row


def attach(gaussians: Gaussians) -> None:
    """Add the tables, unless they are there: no step so far.  Rows of new Gaussians begin anew."""
    if NUMBER not in gaussians.tables:
        for name in gaussians.trained:
            gaussians.add(FOLDER + name, gaussians.tables[name].components, zero_fresh=True)
        gaussians.add(NUMBER, 1, zero_fresh=True)


def add(gaussians: Gaussians) -> None:
    """Add the present parameters to their averages."""
    program, count = gaussians.device.program("average.cl"), gaussians.count
    for name in gaussians.trained:
        program.add_to_average(
            items=(count, gaussians.tables[name].components),
            values=gaussians[name],
            average=gaussians[FOLDER + name],
            number=gaussians[NUMBER],
            stride=gaussians.capacity,
            count=count,
        )
    program.count_step(items=count, number=gaussians[NUMBER], count=count)


def take(gaussians: Gaussians) -> None:
    """Replace the parameters by their averages, those of rows without one stay, and remove the tables."""
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

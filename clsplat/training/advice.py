"""What to try after values that are not finite."""

from collections.abc import Collection

from clsplat.formats.motion import MOTION
from clsplat.gaussians.tables import PARAMETERS
from clsplat.schedule import at_step
from clsplat.training.adam import Rates
from clsplat.training.run import Run

LOWER = 0.1  # times the present rate
VELOCITY = "motion.velocity"  # whose rate is lowered where a motion is broken


def lower_rate(run: Run, broken: Collection[str]) -> str:
    """Return 'place=value' for `--set`: a lower rate of that broken parameter whose rate is the largest by its default.

    The value is a tenth of the present one, or the default where that is smaller.  A field has one rate.
    """
    if run.learned_field:
        (stage,) = run.pipeline["stages"][run.cursor]
        return f"{stage}.rate={LOWER * run.learned_field.rate:.2g}"
    stages, default = run.pipeline["stages"], Rates()
    trains = [(i, name) for i, stage in enumerate(stages) for name, fields in stage.items() if "rates" in fields]
    place, stage = next((found for found in reversed(trains) if found[0] <= run.cursor), (0, "optimize"))
    present = Rates.model_validate(stages[place].get(stage, {}).get("rates", {}))

    def rate(rates: Rates, name: str) -> float:
        return at_step(rates.motion.velocity if name == VELOCITY else getattr(rates, name), run.step)

    names = [VELOCITY if name == MOTION else name for name in broken or PARAMETERS]
    name = max(names, key=lambda name: rate(present, name) / rate(default, name))
    alone = [other for _, other in trains].count(stage) <= 1
    value = min(LOWER * rate(present, name), rate(default, name))
    return f"{stage if alone else f'stages.{place}'}.rates.{name}={value:.2g}"

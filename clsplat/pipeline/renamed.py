"""Old names of keys in pipeline files, which are read for one more release, with a warning.

The new names: `scene.sampling` is `optimize.views.order`, a rule's `after` is `start`, a decay's `start` and `stop` are
`initial` and `final`, `scales` of `evaluate` is `downscales`.
"""

import logging
from dataclasses import dataclass
from functools import cache
from typing import Any

from clsplat.errors import ConfigError

LOG = logging.getLogger("clsplat")


def with_new_names(data: dict[str, Any], warn_about: str = "", old_wins: bool = False) -> dict[str, Any]:
    """Return the data of a pipeline file, stages as {stage: name, …}, with today's keys.

    `warn_about` names the file in warnings; without it there are none.  With `old_wins` an old key, which --set gave
    after the new one, has priority; else both are an error.  Raises ConfigError.
    """
    names = _Names(warn_about, old_wins)
    scene = data.get("scene")
    order = None
    if isinstance(scene, dict) and "sampling" in scene:
        order = scene["sampling"]
        data = {**data, "scene": {key: value for key, value in scene.items() if key != "sampling"}}
        _warn(warn_about, "scene.sampling", f"optimize.views.order: {order}")
    if not isinstance(data.get("stages"), list):
        return data
    return {**data, "stages": [names.stage(stage, order) for stage in data["stages"]]}


@dataclass(frozen=True)
class _Names:
    where: str
    old_wins: bool

    def stage(self, stage: Any, order: Any) -> Any:
        if not isinstance(stage, dict) or stage.get("stage") != "optimize":
            return self._measured(self._densify(stage))
        stage = dict(stage)
        if order is not None and isinstance(views := stage.get("views", {}), dict):
            if "order" in views:
                self._refuse_both("scene.sampling", "optimize.views.order")
            stage["views"] = {**views, "order": order}
        if isinstance(stage.get("rates"), dict):
            stage["rates"] = {
                name: self._decay(rate, f"optimize.rates.{name}") for name, rate in stage["rates"].items()
            }
        if isinstance(stage.get("during"), list):
            stage["during"] = [self._measured(self._densify(inner)) for inner in stage["during"]]
        return stage

    def _decay(self, rate: Any, place: str) -> Any:
        if not isinstance(rate, dict) or "stop" not in rate:
            return rate
        _warn(self.where, f"{place}: {{start, stop}}", "{initial, final}")
        start = {} if "initial" in rate else {"start": "initial"}  # beside `initial` it is today's `start`
        return self._renamed(rate, {**start, "stop": "final"}, place)

    def _measured(self, stage: Any) -> Any:
        if not isinstance(stage, dict) or stage.get("stage") != "evaluate" or "scales" not in stage:
            return stage
        _warn(self.where, "evaluate.scales", "downscales")
        return self._renamed(stage, {"scales": "downscales"}, "evaluate")

    def _densify(self, stage: Any) -> Any:
        if not isinstance(stage, dict) or not isinstance(stage.get("rules"), list):
            return stage
        rules = []
        for rule in stage["rules"]:
            if isinstance(rule, dict) and "after" in rule:
                place = str(rule.get("type", "rule"))
                _warn(self.where, f"{place}.after", "start")
                rule = self._renamed(rule, {"after": "start"}, place)
            rules.append(rule)
        return {**stage, "rules": rules}

    def _renamed(self, keys: dict[str, Any], new_names: dict[str, str], place: str) -> dict[str, Any]:
        old = {name: new for name, new in new_names.items() if name in keys}
        for name, new in old.items():
            if new in keys:
                self._refuse_both(f"{place}.{name}", f"{place}.{new}")
        return {old.get(key, key): value for key, value in keys.items() if key not in old.values()}

    def _refuse_both(self, old: str, new: str) -> None:
        if not self.old_wins:
            raise ConfigError(f"{self.where}: '{new}' is the new name of '{old}', and both are given; remove '{old}'")


@cache  # once for a file, however many cells of a matrix it serves
def _warn(where: str, old: str, new: str) -> None:
    if where:
        LOG.warning("%s: '%s' has a new name, '%s'; the next release removes the old one", where, old, new)

"""Old names of keys in pipeline files, which are read for one more release, with a warning.

The new names: `scene.sampling` is `optimize.views.order`, a rule's `after` is `start`, a decay's `start` and `stop` are
`initial` and `final`.
"""

import logging
from functools import cache
from typing import Any

LOG = logging.getLogger("clsplat")


def with_new_names(data: dict[str, Any], warn_about: str = "") -> dict[str, Any]:
    """Return the data of a pipeline file, stages as {stage: name, …}, with today's keys.

    `warn_about` names the file in warnings; without it there are none.
    """
    where = warn_about
    scene = data.get("scene")
    order = None
    if isinstance(scene, dict) and "sampling" in scene:
        order = scene["sampling"]
        data = {**data, "scene": {key: value for key, value in scene.items() if key != "sampling"}}
        _warn(where, "scene.sampling", f"optimize.views.order: {order}")
    if not isinstance(data.get("stages"), list):
        return data
    stages = [_stage(stage, order, where) for stage in data["stages"]]
    return {**data, "stages": stages}


def _stage(stage: Any, order: Any, where: str) -> Any:
    if not isinstance(stage, dict) or stage.get("stage") != "optimize":
        return _densify(stage, where)
    stage = dict(stage)
    if order is not None and isinstance(stage.get("views", {}), dict):
        stage["views"] = {"order": order, **stage.get("views", {})}
    if isinstance(stage.get("rates"), dict):
        stage["rates"] = {name: _decay(rate, f"optimize.rates.{name}", where) for name, rate in stage["rates"].items()}
    if isinstance(stage.get("during"), list):
        stage["during"] = [_densify(inner, where) for inner in stage["during"]]
    return stage


def _decay(rate: Any, place: str, where: str) -> Any:
    if not isinstance(rate, dict) or "stop" not in rate:
        return rate
    new = {"start": "initial", "stop": "final"}
    _warn(where, f"{place}: {{start, stop}}", "{initial, final}")
    return {new.get(key, key): value for key, value in rate.items()}


def _densify(stage: Any, where: str) -> Any:
    if not isinstance(stage, dict) or not isinstance(stage.get("rules"), list):
        return stage
    rules = []
    for rule in stage["rules"]:
        if isinstance(rule, dict) and "after" in rule:
            _warn(where, f"{rule.get('type', 'rule')}.after", "start")
            rule = {"start" if key == "after" else key: value for key, value in rule.items()}
        rules.append(rule)
    return {**stage, "rules": rules}


@cache  # once for a file, however many cells of a matrix it serves
def _warn(where: str, old: str, new: str) -> None:
    if where:
        LOG.warning("%s: '%s' has a new name, '%s'; the next release removes the old one", where, old, new)

"""Compare the launches that a plan would replay with those of the code that it replaces, argument by argument."""

from collections import Counter
from typing import Any

from clsplat.opencl.device import Array
from clsplat.opencl.plan import Plan, Plans


def launches_of(plan: Plan) -> list[tuple[Any, ...]]:
    """The kernel, sizes and arguments of each launch; for buffers their serial numbers."""
    return [
        (launch.source.label, launch.size, launch.group, [_plain(value) for value in launch.arguments])
        for launch in plan.launches
    ]


def _plain(value: Any) -> Any:
    """A value of which the text tells all: buffers, also in results, by serial number."""
    if isinstance(value, Array):
        return value.shape, value.buffer.serial
    if callable(value):  # a weak reference
        return value().serial
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return {name: _plain(part) for name, part in vars(value).items()} if hasattr(value, "__dict__") else value


def check_replays(monkeypatch) -> Counter[str]:
    """From now on, run the checked path instead of each replay and compare both; return the number of each part."""
    compared: Counter[str] = Counter()
    run = Plans.run

    def check(plans, key, changes, launch, *inputs):
        plan = plans._plans.get(key)
        if plan is None or plans._device.recording.plan is not None:
            return run(plans, key, changes, launch, *inputs)
        plan.bind(changes)
        expected = plans.record(changes, launch, *inputs)
        assert expected.is_replayable
        for replayed, checked in zip(launches_of(plan), launches_of(expected), strict=True):
            assert repr(replayed) == repr(checked), key[0]  # in texts, 0.0 differs from -0.0
        assert repr(_plain(plan.result)) == repr(_plain(expected.result)), key[0]
        expected.release()
        compared[key[0]] += 1
        return expected.result

    monkeypatch.setattr(Plans, "run", check)
    return compared

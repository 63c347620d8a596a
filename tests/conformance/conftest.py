"""Fixtures of the conformance tests."""

import pickle
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from clsplat.conformance import reference

DEAR = ("blend", "blend_backward", "blend_weights", "falloff_squares", "inverse_depth", "inverse_depth_backward")
DEAR += ("margin", "project", "project_backward")
_results: dict[bytes, bytes] = {}


@pytest.fixture(scope="module")
def cache_references() -> Iterator[None]:
    """Compute the reference of a scene once for all settings and faults: it depends on its arguments only."""
    with pytest.MonkeyPatch.context() as patch:
        for name in DEAR:
            patch.setattr(reference, name, _once(name, getattr(reference, name)))
        yield


def _once(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: Any, **named: Any) -> Any:
        key = pickle.dumps((name, arguments, named))
        if key not in _results:
            _results[key] = pickle.dumps(function(*arguments, **named))
        return pickle.loads(_results[key])  # each caller has a copy to change

    return call

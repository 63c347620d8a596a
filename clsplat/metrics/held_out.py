"""PSNR of a scene that moves, apart for moments that training has seen and for those that it has not."""

from collections.abc import Sequence
from dataclasses import replace

from clsplat.metrics.views import ViewMetrics
from clsplat.scene.times import moments_of
from clsplat.scene.view import View

HELD_OUT, OTHERS = "psnr_held_out_moments", "psnr_other_moments"


def by_moment(results: Sequence[ViewMetrics], views: Sequence[View], trained: Sequence[View]) -> list[ViewMetrics]:
    """Return the metrics with the PSNR once more, by whether a view's moment is one of the views that are trained on.

    They stay as they are where only one of both kinds is there, as where nothing moves.
    """
    known, times = set(moments_of(trained)), {view.name: view.time for view in views}
    kinds = {name: OTHERS if time in known else HELD_OUT for name, time in times.items() if time is not None}
    if not known or {kinds.get(result.view) for result in results} != {HELD_OUT, OTHERS}:
        return list(results)
    return [replace(result, moments={kinds[result.view]: result.psnr}) for result in results]

"""PSNR of a scene that moves, apart for moments that training has seen and for those that it has not."""

from collections.abc import Mapping, Sequence

from clsplat.scene.times import moments_of
from clsplat.scene.view import View

HELD_OUT, OTHERS = "psnr_held_out_moments", "psnr_other_moments"


def by_moment(psnr: Mapping[str, float], views: Sequence[View], trained: Sequence[View]) -> dict[str, dict[str, float]]:
    """Return the PSNR of views, dB, by their names, once more by whether the moment is one of the views trained on.

    There is none where only one of both kinds is there, as where nothing moves.
    """
    known, times = set(moments_of(trained)), {view.name: view.time for view in views}
    kinds = {name: OTHERS if time in known else HELD_OUT for name, time in times.items() if time is not None}
    if not known or {kinds.get(name) for name in psnr} != {HELD_OUT, OTHERS}:
        return {}
    return {name: {kinds[name]: value} for name, value in psnr.items()}

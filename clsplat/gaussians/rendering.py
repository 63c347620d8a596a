"""The numbers with which a model is rendered, as its file says them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from clsplat.formats.splats import MIP_VARIANCE, NEAR, VARIANCE


@dataclass(frozen=True)
class Rendering:
    """The numbers with which a model is rendered."""

    near: float = NEAR  # scene units; nearer Gaussians are not drawn
    screen_variance: float = VARIANCE  # px², added to every splat
    compensate: float = 0.0  # 1: the opacity falls as that variance spreads a splat out
    background: Literal["black", "white"] | None = None  # None: what the scene says
    alpha: Literal["transparency", "mask"] = "transparency"  # what the fourth channel of its photographs was
    notes: Mapping[str, Any] = field(default_factory=dict)  # what else the file says
    pixel_box: float = 0.0  # 1: splats are integrated over the pixel's box instead; screen_variance is for viewers

    @classmethod
    def of(cls, comment: Mapping[str, Any], mode: str) -> "Rendering":
        """Take the numbers from a file's comment; files of other programs get those of 3DGS or Mip-Splatting."""
        mip = {"screen_variance": MIP_VARIANCE, "compensate": 1.0} if mode == "mip" else {}
        names = ("near", "screen_variance", "compensate", "pixel_box")
        given = {name: float(comment[name]) for name in names if isinstance(comment.get(name), int | float)}
        return cls(
            **{**mip, **given},
            background=comment["background"] if comment.get("background") in ("black", "white") else None,
            alpha="mask" if comment.get("alpha") == "mask" else "transparency",
            notes=dict(comment),
        )

    def comment(self) -> dict[str, Any]:
        """What a model file says about rendering."""
        numbers = {"near": self.near, "screen_variance": self.screen_variance, "compensate": self.compensate}
        known: dict[str, Any] = {"background": self.background} if self.background else {}
        if self.pixel_box or "pixel_box" in self.notes:  # files of other models stay as they are
            known["pixel_box"] = self.pixel_box
        return {**self.notes, **numbers, **known, "alpha": self.alpha}

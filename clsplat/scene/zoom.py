"""Lenses whose focal length is another one than was calibrated: the photograph that they undistort stays the same.

A lens of focal length f moves normalised coordinates u to D(u), and the pinhole camera of the undistorted photograph
has the same f.  Where that camera has s f, the lens of s f with D'(u) = D(s u) / s undistorts to the same pixels: a
coefficient of a polynomial term of degree n + 1 is multiplied by s^n.
"""

import math
from dataclasses import replace

from clsplat.errors import DataError
from clsplat.scene.lens import MODELS, Lens
from clsplat.scene.view import View

ROUNDING = 1e-12

DEGREES: dict[str, tuple[int, ...]] = {  # n of each coefficient after the middle, in COLMAP's order
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (2,),
    "RADIAL": (2, 4),
    "OPENCV": (2, 4, 1, 1),
    "FULL_OPENCV": (2, 4, 1, 1, 6, 2, 4, 6),
}


def zooms(lens: Lens) -> bool:
    """Return whether there is such a lens for any factor: a fisheye has none of its model."""
    return lens.model in DEGREES


def zoomed(lens: Lens, factor: float) -> Lens:
    """Return a lens with the focal length times a factor, whose undistorted photograph is the same.

    Raises DataError where its model has none.
    """
    if factor == 1:
        return lens
    if not zooms(lens):
        raise DataError(
            f"the lens {lens.model} has no form with another focal length; expected one of {', '.join(DEGREES)}: "
            "`clsplat data undistort` first"
        )
    focals = MODELS[lens.model][0]
    lengths, middle, rest = lens.params[:focals], lens.params[focals : focals + 2], lens.params[focals + 2 :]
    scaled = [value * factor**degree for value, degree in zip(rest, DEGREES[lens.model], strict=True)]
    return replace(lens, params=(*(factor * length for length in lengths), *middle, *scaled))


def lens_of(view: View) -> Lens:
    """Return the lens of a view's photograph as it is on disk: a pinhole where it has no distortion.

    Raises DataError where its focal length was learned and its model has none with another.
    """
    c, lens = view.camera, view.lens
    if lens is None:
        return Lens(c.width, c.height, "PINHOLE", (c.fx, c.fy, c.cx, c.cy))
    factor = c.fx / lens.pinhole.resized(c.width, c.height).fx  # 1, unless the focal length was learned
    return lens if math.isclose(factor, 1, rel_tol=ROUNDING) else zoomed(lens, factor)

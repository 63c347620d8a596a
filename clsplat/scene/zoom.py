"""Lenses whose focal length is another one than was calibrated: the photograph that they undistort stays the same.

A lens of focal length f moves normalised coordinates u to D(u), and the pinhole camera of the undistorted photograph
has the same f.  Where that camera has s f, the lens of s f with D'(u) = D(s u) / s undistorts to the same pixels: a
coefficient of a polynomial term of degree n + 1 is multiplied by s^n.
"""

from dataclasses import replace

from clsplat.errors import DataError
from clsplat.scene.lens import MODELS, Lens

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

"""PSNR of a rendered image in the colours of its photograph, which no training has seen.

Two figures beside PSNR, never in its place.  `psnr_colour`: each half of the image is changed as the other half of the
photograph asks for, so that no pixel is measured in colours that were fitted to it.  `psnr_affine`: what gsplat calls
colour-corrected, fitted on the whole photograph, to compare with its figures alone.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.metrics.images import Mask, psnr
from clsplat.metrics.stillness import means
from clsplat.views.colours import OwnColours

LEAST = 1e-3  # slope of a regression, below which there is nothing to divide by
# Usable pixels for each number that is fitted to a channel: p numbers of n independent errors add p / n of their
# variance to what is measured elsewhere, here 1 / 64, which is 0.07 dB.
PIXELS = 64


def colour_figures(
    image: NDArray[np.float32], photograph: NDArray[np.uint8], mask: Mask | None, model: OwnColours
) -> dict[str, float]:
    """Return `psnr_colour` and `psnr_affine`, dB, of an image as it was rendered and a photograph, [height, width, 3].

    mask: pixels that count, [height, width].  Without `psnr_colour` where a half has too few pixels to fit colours to.
    Of the image NaN counts as black, and what is infinite as white or black.
    """
    truth, finite = photograph / 255.0, np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0)
    counted = np.ones(truth.shape[:2], bool) if mask is None else mask
    changed = in_colours_of(finite, photograph, counted, model)
    corrected = corrected_by_regression(finite, truth, counted)
    own = {} if changed is None else {"psnr_colour": psnr(changed, photograph, counted)}
    return {**own, "psnr_affine": psnr(corrected, photograph, counted)}


def mean_figures(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Return the averages over views of what colour_figures returned, with the keys of metrics.json.

    Where views have no `psnr_colour`, `psnr_colour_views` is the number of those that have, and `psnr_colour_reason`
    says why; where none has, it is None.
    """
    found, has = means(rows), [row for row in rows if "psnr_colour" in row]
    if not found or len(has) == len(rows):
        return found
    reason = f"{len(rows) - len(has)} of {len(rows)} views have a half with too few pixels to fit colours to"
    return {"psnr_colour": None, **found, "psnr_colour_views": len(has), "psnr_colour_reason": reason}


def in_colours_of(
    image: NDArray[np.float64], photograph: NDArray[np.uint8], counted: Mask, model: OwnColours
) -> NDArray[np.float64] | None:
    """Return the image with each half, left and right, in the colours that the other half of the photograph asks for.

    Pixels that are black or white in the photograph say nothing of its colours.  None where a half has fewer than
    PIXELS others for each number that is fitted to a channel: that depends on the photograph and the mask alone, so
    that models are compared on the same views.  Those beyond white in the image are left out of the fit where enough
    others are left; else all count.
    """
    usable = counted & ((photograph > 0) & (photograph < 255)).all(axis=2)
    middle, truth, changed = image.shape[1] // 2, photograph / 255.0, image.copy()
    left, right = np.s_[:, :middle], np.s_[:, middle:]
    fewest = PIXELS * model.fitted_to_a_channel
    if min(np.count_nonzero(usable[half]) for half in (left, right)) < fewest:
        return None
    for half, other in ((left, right), (right, left)):
        below = usable[other] & (image[other] < 1).all(axis=2)
        fitted_to = below if np.count_nonzero(below) >= fewest else usable[other]
        matrix = model.fitted(image[other][fitted_to], truth[other][fitted_to])
        changed[half] = np.minimum(np.einsum("hwc,ac->hwa", image[half], matrix[:, :3]) + matrix[:, 3], 1)
    return changed


def corrected_by_regression(
    image: NDArray[np.float64], truth: NDArray[np.float64], counted: Mask
) -> NDArray[np.float64]:
    """Return (image - b) / a of each channel, where a truth + b is nearest to the image (gsplat).

    Regressing the image on the photograph divides by a slope that noise makes too small: no least-squares correction.
    """
    corrected = image.copy()
    for channel in range(3):
        x, y = truth[..., channel][counted], image[..., channel][counted]
        variance = float(np.mean((x - x.mean()) ** 2))
        slope = float(np.mean((x - x.mean()) * (y - y.mean()))) / variance if variance > 0 else 1.0
        if abs(slope) > LEAST:
            corrected[..., channel] = (image[..., channel] - (y.mean() - slope * x.mean())) / slope
    return np.clip(corrected, 0, 1)

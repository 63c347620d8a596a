"""What a rule may ask an edit for: numbers of rows that can be, for the Gaussians of a mask."""

import numpy as np
from numpy.typing import NDArray

MAX_ROWS = 2**32 - 2  # sums of 32 bits stay at one more, whatever more there is (cl_kernels/scan.cl)


def require_rows(copies: int, kept: int) -> None:
    """Raise ValueError for numbers of rows that cannot be."""
    for name, number in (("copies", copies), ("kept", kept)):
        if not 0 <= number <= MAX_ROWS:
            bound = "0 or more" if number < 0 else f"at most {MAX_ROWS}"
            raise ValueError(f"{name}: expected a number of rows, {bound}, got {number}")


def outcomes_of(
    chosen: NDArray[np.bool_], copies: int | NDArray[np.integer], kept: int, count: int
) -> NDArray[np.uint32]:
    """Return copies + 1 for the Gaussians that are chosen, 0 for the others, [N]; ValueError as `Edit.choose`."""
    numbers = np.asarray(copies)
    if chosen.dtype != np.bool_ or chosen.shape != (count,):
        raise ValueError(f"chosen: expected a mask, bool [{count}], got {chosen.dtype} {list(chosen.shape)}")
    if not np.issubdtype(numbers.dtype, np.integer) or numbers.shape not in ((), (count,)):
        raise ValueError(
            f"copies: expected an integer or integers [{count}], got {numbers.dtype} {list(numbers.shape)}"
        )
    require_rows(int(numbers.min(initial=0)), kept)
    require_rows(int(numbers.max(initial=0)), kept)
    return np.where(chosen, numbers.astype(np.int64) + 1, 0).astype(np.uint32)

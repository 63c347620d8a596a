"""Rows of tables, as a caller gives them and as a kernel takes them."""

import numpy as np
from numpy.typing import NDArray


def checked_rows(rows: NDArray[np.integer], count: int) -> NDArray[np.uint32]:
    """Return rows, [n], as a kernel takes them; raise ValueError unless they are different integers in [0, count)."""
    if rows.ndim != 1 or not np.issubdtype(rows.dtype, np.integer):
        raise ValueError(
            f"rows: expected integers [n], got {rows.dtype} {list(rows.shape)}; np.flatnonzero gives the rows of a mask"
        )
    outside = rows[(rows < 0) | (rows >= count)]
    if len(outside):
        raise ValueError(f"rows: expected integers in [0, {count}), got {outside[0]}")
    times = np.bincount(rows.astype(np.int64), minlength=1)
    if times.max() > 1:
        raise ValueError(f"rows: expected each row once, got row {times.argmax()} {times.max()} times")
    return rows.astype(np.uint32)

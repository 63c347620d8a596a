"""A number of Gaussians that growth comes to at its end, and not before (Taming 3DGS, Mallick et al. 2024)."""

from typing import Annotated

from pydantic import Field

from clsplat.settings import Settings


class Reach(Settings):
    """Growth along a parabola, which is steep at first: P0 + (B - P0) (2x/S - x²/S²) after x of S edits.

    It is planned anew at every edit from the number that there is, so that it needs no P0 and makes up for what was
    pruned.
    """

    reach: Annotated[int, Field(ge=1)]
    """The number B, to which the last edit may grow."""

    def limit(self, count: int, edits: int) -> int:
        """Return to what number an edit of `count` Gaussians may grow, when so many edits are left with it."""
        missing = self.reach - count
        return self.reach - int(missing * ((edits - 1) / edits) ** 2) if missing > 0 else self.reach

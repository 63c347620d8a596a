"""The work of a step, and a lower bound of its time.

A stage's floor is the larger of its arithmetic by the multiply-add peak and of its bytes by the copy bandwidth; the
counts are those of the algorithm, not of the code, so a ratio of 1 cannot be reached and 2 is good.
"""

from dataclasses import dataclass

from clsplat.bench.peaks import Peaks


@dataclass(frozen=True)
class Work:
    """The work of one step."""

    gaussians: int
    pairs: int
    rows: int  # (pair, pixel row) combinations that blending computes, 16 pixels each
    pixels: int


def floors(work: Work, peaks: Peaks) -> dict[str, float]:
    """Return the lower bound of each stage, ms.

    Blending is counted in vector instructions of 16 lanes (31 a row forward; 80 a row and 60 a pair backward), which
    issue at the rate of multiply-adds; the other stages in operations and bytes (473 operations and 236 bytes of
    parameters a Gaussian, 59 parameters with gradient and two moments, 64 bytes a record, …).
    """
    n, pairs, pixels = work.gaussians, work.pairs, work.pixels

    def floor(operations: float, moved: float) -> float:
        return 1e3 * max(operations / (1e9 * peaks.gflops), moved / (1e9 * peaks.gbytes))

    vector = 2 * 16  # operations of a multiply-add instruction
    return {
        "project": floor(380 * n, (236 + 64 + 8) * n),
        "pairs": floor(80 * pairs, 2 * 64 * n + 12 * pairs),
        "sort": floor(0, 64 * n + 24 * pairs),
        "blend": floor(31 * vector * work.rows, 64 * pairs),
        "loss": floor(1250 * pixels, 60 * pixels),
        "blend backward": floor(vector * (80 * work.rows + 60 * pairs), 128 * pairs),
        "sum records": floor(9 * pairs, 64 * pairs + 36 * n),
        "update": floor((900 + 12 * 59) * n, (64 + 36 + 8 + 24 * 59) * n),
        "statistics": floor(0, 20 * n),
    }

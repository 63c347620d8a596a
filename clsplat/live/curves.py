"""What the reports of a run say, as points of curves."""

from clsplat.progress import Progress

MOST = 600  # points that are kept: of more, every second one goes
Point = tuple[int, float, float, int | None]  # step, loss, PSNR in dB, Gaussians


class Curves:
    """The points of one run, in the order of their steps."""

    def __init__(self, points: list[Point]) -> None:
        self._points = points
        self._thin()

    def add(self, progress: Progress) -> None:
        self._points.append((progress.step, round(progress.loss, 6), round(progress.psnr, 3), progress.gaussians))
        self._thin()

    def after(self, step: int) -> list[Point]:
        """Return the points behind a step."""
        return [point for point in list(self._points) if point[0] > step]

    def _thin(self) -> None:
        while len(self._points) > MOST:
            self._points = [*self._points[:-1:2], self._points[-1]]

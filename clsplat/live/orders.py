"""Pictures that pages wait for, from a few at a time."""

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

from clsplat.scene.view import View

MOST = 4  # that wait at a time
Pace = Literal["moving", "still", "again"]  # in motion; at rest for the first time; the same once more


@dataclass(frozen=True)
class Picture:
    """An encoded picture, and the step that it shows."""

    jpeg: bytes
    step: int


@dataclass(eq=False)
class Order:
    """A camera that a page looks through."""

    page: int  # a number that tells pages apart
    view: View
    pace: Pace
    done: threading.Event = field(default_factory=threading.Event)
    picture: Picture | None = None


class Orders:
    """A short queue between the threads that answer and the one that trains."""

    def __init__(self) -> None:
        self._waiting: deque[Order] = deque()
        self._changed = threading.Condition()

    def ask(self, order: Order, seconds: float) -> bool:
        """Wait for the picture of an order, in the place of one that its page still waits for.

        Returns False where too many wait; the order has no picture when the time was too short.
        """
        with self._changed:
            before = next((other for other in self._waiting if other.page == order.page), None)
            if before is None and len(self._waiting) >= MOST:
                return False
            if before is not None:
                self._waiting.remove(before)
                before.done.set()
            self._waiting.append(order)
            self._changed.notify_all()
        order.done.wait(seconds)
        self._drop(order)
        return True

    def _drop(self, order: Order) -> None:
        with self._changed:
            if order in self._waiting:
                self._waiting.remove(order)

    def first(self) -> Order | None:
        """The order that has waited longest for a picture of a camera in motion, else of one at rest."""
        with self._changed:
            return min(self._waiting, key=lambda order: order.pace == "again", default=None)

    def deliver(self, order: Order, picture: Picture | None) -> None:
        """End the wait."""
        self._drop(order)
        order.picture = picture
        order.done.set()

    def wait(self, seconds: float) -> None:
        """Wait until something is asked for, or the pause ends."""
        with self._changed:
            if not self._waiting:
                self._changed.wait(seconds)

    def wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def __bool__(self) -> bool:
        return bool(self._waiting)

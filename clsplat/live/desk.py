"""What the thread that trains and the threads that answer share."""

import time
from dataclasses import dataclass, field
from typing import Any

from clsplat.live.budget import Budget
from clsplat.live.curves import Curves
from clsplat.live.orders import Orders
from clsplat.live.pictures import Pictures
from clsplat.scene.view import View
from clsplat.training.status import StatusFile

SHARE = 0.025  # of the time, for pictures; the lead that the host loses by each, and answers, cost about as much again
SAVED = 1.0  # s of it that are kept for a motion
RESERVE = 0.3  # s of those that pictures of a camera at rest leave alone


@dataclass(frozen=True)
class Shown:
    """What a page needs to know of one run; another run of a matrix has another number."""

    number: int
    title: str
    views: tuple[View, ...]
    scene: dict[str, Any]  # what live.js reads
    pictures: Pictures
    curves: Curves


@dataclass
class Desk:
    """The state of a live preview; each field is written by one side and replaced as a whole."""

    orders: Orders = field(default_factory=Orders)
    budget: Budget = field(default_factory=lambda: Budget(SHARE, SAVED))
    status: StatusFile | None = None
    shown: Shown | None = None
    step: int = 0  # of the model that can be drawn; 0: none can
    paused: bool = False
    ended: bool = False
    told: bool = False  # that it has ended, to a page
    fault: str = ""  # why there are no pictures
    heard: float = float("-inf")  # when a page last asked

    def hear(self) -> None:
        """Note that somebody looks."""
        self.heard = time.monotonic()

    def silent(self) -> float:
        """Return for how long no page has asked, s."""
        return time.monotonic() - self.heard

    def pause(self, paused: bool) -> None:
        """Let the training wait, or go on."""
        self.paused = paused
        self.orders.wake()

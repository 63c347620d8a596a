"""A share of the time, saved up to a limit."""

import threading
import time
from collections.abc import Callable


class Budget:
    """Credit that grows with time: who asks before an expense spends no more than `share` of the time that passed."""

    def __init__(self, share: float, most: float, clock: Callable[[], float] = time.monotonic) -> None:
        """share: credit a second; most: credit that is kept: a rest is followed by a burst and not by a flood."""
        self.share, self.most, self.spent = share, most, 0.0
        self._clock, self._credit, self._at = clock, 0.0, clock()
        self._lock = threading.Lock()

    @property
    def credit(self) -> float:
        """What may be spent now; negative after an expense that was larger than its estimate."""
        with self._lock:
            return self._grown()

    def spend(self, amount: float) -> None:
        """Take an expense off the credit."""
        with self._lock:
            self._credit = self._grown() - amount
            self.spent += amount

    def skip(self) -> None:
        """Let the time since the last question give no credit."""
        with self._lock:
            self._at = self._clock()

    def _grown(self) -> float:
        now = self._clock()
        self._credit = min(self.most, self._credit + self.share * (now - self._at))
        self._at = now
        return self._credit

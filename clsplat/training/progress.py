"""How far a training is, for those who watch it."""

from dataclasses import dataclass

from clsplat.errors import Interrupted


class Stopped(Interrupted):
    """A stage has ended before its end, since the run is to stop; it is repeated when the run goes on."""


@dataclass(frozen=True)
class Progress:
    """The state of training, for the terminal."""

    step: int
    steps: int
    loss: float
    psnr: float  # dB, the mean over the training views of the last reports, before 8 bits
    gaussians: int | None  # None: what is trained are none
    milliseconds: float  # per step
    seconds_left: float
    growth_known: bool = True  # False: rules will make steps slower, and it is not known yet how much

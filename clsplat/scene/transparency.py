"""Whether photographs show a background behind them."""

from clsplat.scene.scene import Scene
from clsplat.scene.view import load_transparency, some_of

LOOKED_AT = 3  # training photographs: what is shown may fill one of them


def is_transparent(scene: Scene) -> bool:
    """Return whether one of some training photographs has transparent pixels that count.  Raises DataError."""
    return any(load_transparency(view) is not None for view in some_of(scene.split("train"), LOOKED_AT))

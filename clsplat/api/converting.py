"""Model files in another format, as a function."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from clsplat.api.arguments import PathLike


def convert(
    sources: PathLike | Sequence[PathLike],
    out: PathLike,
    *,
    sh_degree: int | None = None,
    sh_bits: str | None = None,
    axes: Literal["spz", "ply"] = "spz",
    spz_version: int = 3,
    quality: Literal["small", "balanced", "high"] = "balanced",
    keep_nan: bool = False,
    crop: str | Sequence[float] | None = None,
    transform: str | None = None,
    drop_below: float = 0.0,
    time: float | None = None,
    frames: int | None = None,
) -> dict[str, Any]:
    """Write models, merged, as one file of the format that its name stands for; return `format`, `gaussians`, `bytes`.

    sh_bits: of SPZ, such as "8/6"; axes: of SPZ files that are read, or where none is of the one that is written; crop:
    x0, y0, z0, x1, y1, z1 in scene units, after `transform`, such as "scale=2 rotate=90,0,0" (degrees); drop_below: an
    opacity.  Gaussians that are not finite are dropped, unless `keep_nan`.
    time: the moment of a moving model, from 0 to 1, that a static one is written of; frames: so many moments, each in a
    file of its own: `out` is a folder, for PLY, or the name whose number is still to come.
    """
    from clsplat.gaussians import conversion
    from clsplat.gaussians.frames import checked_time, convert_frames
    from clsplat.runs.source import refuse_field

    files = [Path(source) for source in ([sources] if isinstance(sources, str | Path) else sources)]
    for file in files:
        refuse_field(file)
    box = crop if isinstance(crop, str) or crop is None else ",".join(map(str, crop))
    options = conversion.Options(sh_bits, axes, spz_version, quality, keep_nan)
    changes = conversion.Changes(
        drop_below,
        None if transform is None else conversion.transform_of(transform),
        None if box is None else conversion.crop_of(box),
        conversion.checked_degree(sh_degree),
        checked_time(time),
    )
    if frames is not None:
        return convert_frames(files, Path(out), frames, changes, options)
    return conversion.convert(files, Path(out), changes, options)

"""Render HTML pages that open offline: each page is one file that contains its styles, charts, and images.

Templates, styles, and scripts are in `templates/`.  Templates escape every value except the charts of
`clsplat.viewer.charts` and the scripts and styles of the package.
"""

import base64
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.reading import read_file

TEMPLATES = Environment(
    loader=PackageLoader("clsplat.core"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
TEMPLATES.policies["json.dumps_kwargs"] = {"separators": (",", ":")}  # `tojson` escapes <, >, & and ' by itself
JPEG_QUALITY = 92


def render(template: str, **values: Any) -> str:
    """Render a template from `templates/` and return the page.  Invalid Unicode becomes `?`."""
    text = TEMPLATES.get_template(template).render(**values)
    return text.encode("utf-8", "replace").decode("utf-8")


def require_complete(path: Path) -> None:
    """Raise DataError if a page cannot be read or is truncated."""
    if not read_file(path).rstrip().endswith(b"</html>"):
        raise DataError(f"{path}: is truncated; create the page again")


def mark_charts_safe(drawings: Iterable[str]) -> list[Markup]:
    """Mark SVG drawings as safe for templates, and drop empty ones."""
    return [_mark_safe(drawing) for drawing in drawings if drawing]


@dataclass(frozen=True)
class Inline:
    """A script or style of the package, with the hash by which a page's content security policy allows it."""

    text: Markup
    hash: str


def inline(text: str) -> Inline:
    """Mark a script or style of the package as safe.  Raises ValueError if the text would close its HTML element."""
    if "</" in text:
        raise ValueError("a script or style contains '</', which closes its element")
    digest = hashlib.sha256(text.encode()).digest()
    return Inline(_mark_safe(text), f"sha256-{base64.b64encode(digest).decode()}")


def _mark_safe(text: str) -> Markup:
    return Markup(text)


def duration_text(seconds: float) -> str:
    """Format a duration: `1 h 2 min`, `3 min 4 s`, `5 s`."""
    minutes, seconds = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


def data_url(image: NDArray[np.uint8], suffix: str = ".jpg") -> str:
    """Encode an RGB image, [height, width, 3], as a data URL in JPEG format, or in PNG format if `suffix` is .png."""
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if suffix == ".jpg" else []
    _, data = cv2.imencode(suffix, image[..., ::-1], options)
    subtype = "jpeg" if suffix == ".jpg" else "png"
    return f"data:image/{subtype};base64,{base64.b64encode(data.tobytes()).decode()}"


def downscale(image: NDArray[np.uint8], max_side: int) -> NDArray[np.uint8]:
    """Downscale an image so that its longer side is at most `max_side` px."""
    height, width = image.shape[:2]
    factor = max_side / max(width, height)
    if factor >= 1:
        return image
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


# Summaries of models and scenes in notebooks.

THUMBNAIL = 160  # px, the longer side


def render_summary(rows: Mapping[str, str], images: Sequence[tuple[str, NDArray[np.uint8]]] = ()) -> str:
    """Return an HTML fragment with a table of names and values, and thumbnails of RGB images, [height, width, 3]."""
    thumbnails = [(name, data_url(downscale(image, THUMBNAIL))) for name, image in images]
    return render("notebook.html.j2", rows=rows, thumbnails=thumbnails)

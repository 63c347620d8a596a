"""Pieces of the pages that open offline: one file of HTML with its style, figures and pictures inside."""

import base64
import html
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1060px;margin:2rem auto;padding:0 1rem;color:#1a202c}
h1{font-size:1.5rem;margin-bottom:.2rem}h2{font-size:1.1rem;margin-top:2.2rem}p.sub{color:#4a5568;margin-top:0}
dl.figures{display:flex;flex-wrap:wrap;gap:1.2rem 2.4rem}dl.figures dt{color:#4a5568;font-size:.85rem}
dl.figures dd{margin:0;font-size:1.35rem;font-weight:600}
.curves{display:grid;grid-template-columns:repeat(auto-fit,minmax(420px,1fr));gap:1rem}
svg{width:100%;height:auto;background:#f7fafc;border-radius:6px}svg text{font:11px system-ui;fill:#4a5568}
svg text.title{font-weight:600;fill:#1a202c;font-size:12px}svg .grid{stroke:#e2e8f0}
table{border-collapse:collapse}td,th{padding:.15rem .9rem .15rem 0;text-align:right}
th:first-child,td:first-child{text-align:left}
td.bar{width:320px}td.bar i{display:block;height:.8rem;background:#2b6cb0;border-radius:2px}
figure{margin:0 0 1.2rem}figure div{display:grid;grid-template-columns:repeat(3,auto);gap:.4rem;width:fit-content}
figure img{max-width:100%;max-height:26rem;border-radius:4px}figcaption{font-size:.9rem;color:#4a5568}
pre{background:#f7fafc;padding:1rem;border-radius:6px;overflow:auto;font-size:12px}
"""


def page(title: str, subtitle: str, sections: Sequence[str], style: str = "", script: str = "") -> str:
    """Return the whole file; `title` and `subtitle` are plain text, the sections HTML."""
    title = html.escape(title)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}{style}</style>'
        f"<h1>{title}</h1><p class=sub>{html.escape(subtitle)}</p>{''.join(sections)}"
        f"{f'<script>{script}</script>' if script else ''}</html>\n"
    )


def figures(values: Mapping[str, str]) -> str:
    """Large figures, each under its name."""
    return "<dl class=figures>" + "".join(f"<div><dt>{k}</dt><dd>{v}</dd></div>" for k, v in values.items()) + "</dl>"


def duration(seconds: float) -> str:
    """A time as people say it."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {rest} s"


def embedded(image: NDArray[np.uint8], suffix: str = ".jpg") -> str:
    """An RGB image, [height, width, 3], as an address that holds its data: .jpg, or .png to keep every bit."""
    options = [cv2.IMWRITE_JPEG_QUALITY, 92] if suffix == ".jpg" else []
    _, data = cv2.imencode(suffix, image[..., ::-1], options)
    kind = "jpeg" if suffix == ".jpg" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"

"""A run's report as one self-contained HTML file."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1000px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.15rem; margin-top: 2rem }
.verdict { font-size: 1.05rem } .good { color: #1a7f37 } .bad { color: #c62828 }
table { border-collapse: collapse; margin: .5rem 0 } td, th { padding: .25rem .8rem; border-bottom: 1px solid #ddd }
td, th { text-align: left }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums }
img { max-width: 100%; border: 1px solid #ddd } figure { margin: 1rem 0 } figcaption { color: #555; font-size: .9rem }
.scroll { overflow-x: auto }
"""


def page(title: str, sections: list[str]) -> str:
    """A whole document."""
    body = "\n".join(sections)
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n'
    )


def heading(text: str, level: int = 2) -> str:
    """A heading."""
    return f"<h{level}>{escape(text)}</h{level}>"


def paragraph(text: str, mark: str = "") -> str:
    """A paragraph; `mark` is a class of the style sheet."""
    return f'<p class="{mark}">{escape(text)}</p>'


def table(header: list[str], rows: list[list[Any]]) -> str:
    """A table; numbers are set to the right."""
    head = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "".join("<tr>" + "".join(_cell(value) for value in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'


def picture(path: Path, caption: str) -> str:
    """A PNG inside the document, as it is."""
    return _figure("png", path.read_bytes(), caption)


def photograph(path: Path, caption: str) -> str:
    """A picture inside the document as JPEG, which is a fraction of a camera image's size."""
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    _, data = cv2.imencode(".jpg", np.asarray(image), [cv2.IMWRITE_JPEG_QUALITY, 85])
    return _figure("jpeg", data.tobytes(), caption)


def _figure(kind: str, content: bytes, caption: str) -> str:
    data, text = base64.b64encode(content).decode("ascii"), escape(caption)
    return f'<figure><img alt="{text}" src="data:image/{kind};base64,{data}"><figcaption>{text}</figcaption></figure>'


def _cell(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return f"<td>{escape(str(value))}</td>"
    return f'<td class="number">{value:.4g}</td>' if isinstance(value, float) else f'<td class="number">{value}</td>'

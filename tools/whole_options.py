"""Hook of MkDocs: an option in a text, such as `--out`, is not broken at its hyphens."""

from __future__ import annotations

import re

CODE = re.compile(r"<code>(.*?)</code>", re.S)
OPTION = re.compile(r"(?<![\w-])--?[a-z][\w-]*")


def on_page_content(html: str, **_: object) -> str:
    """Return a page with its options in elements that the style sheet keeps whole."""
    return CODE.sub(lambda code: OPTION.sub(r'<span class="whole">\g<0></span>', code[0]), html)

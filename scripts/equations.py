"""Hook of `make docs`: equations in LaTeX on lines of their own, which GitHub draws, become MathML, which browsers draw
without a program from elsewhere."""

import re
from typing import Any

from latex2mathml.converter import convert


def on_page_markdown(markdown: str, **_: Any) -> str:
    return re.sub(
        r"^\$\$(.+)\$\$$",
        lambda found: f"<div>{convert(found[1], display='block')}</div>",
        markdown,
        flags=re.MULTILINE,
    )

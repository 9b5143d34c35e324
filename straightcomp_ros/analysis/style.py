"""The one style of what a person looks at: the sheet `style.css`, and its colours for pictures."""

import re
from importlib.resources import files

SHEET = files(__package__).joinpath("style.css").read_text(encoding="utf-8")
_COLOURS = dict(re.findall(r"--([\w-]+):(#\w{6})", SHEET.partition("}")[0]))
BLACK, BLUE, VERMILION, GREEN, GREY = (_COLOURS[name] for name in ("black", "blue", "vermilion", "green", "grey"))
PALE_BLUE, PALE_VERMILION, GRID, SOFT = (_COLOURS[name] for name in ("pale-blue", "pale-vermilion", "line", "soft"))

"""Docstrings for the site: the reStructuredText in them (`:math:`, `.. math::`) becomes Markdown,
what a method reduces to and where it departs from print become boxes, names become links."""

import re
import sys
import textwrap
from pathlib import Path
from typing import Any

from griffe import Extension, Object

sys.path.insert(0, str(Path(__file__).parent))
from names import linked

INLINE = re.compile(r":math:`([^`]*)`")
BLOCK = re.compile(r"^( *)\.\. math::\n((?:\1 +.*\n|[ \t]*\n)+)", re.MULTILINE)
BOXES = {"Reduces to": "success", "Deviations": "info", "See also": "tip"}
BOX = re.compile(r"^(Reduces to|Deviations|See also): (.*\n?(?:^ +.*\n?|^\n(?= ))*)", re.MULTILINE)
FIELD = re.compile(r"^([a-z_]\w*(?:, [a-z_]\w*)*)( \([^)]*\))?: (.*\n?(?:^ +.*\n?)*)", re.MULTILINE)


def fields(text: str) -> str:
    """What the docstring of a class says of its fields, `name: text`, as a list."""

    def item(match: re.Match[str]) -> str:
        first, _, rest = match[3].partition("\n")
        body = textwrap.indent(textwrap.dedent(rest), "    ")
        return f"\n* **{match[1]}**{match[2] or ''}: {first}\n{body}"

    return FIELD.sub(item, text)


def markdown(text: str) -> str:
    """A docstring as Markdown with mathematics between dollars."""

    def block(match: re.Match[str]) -> str:
        lines = textwrap.dedent(match[2]).strip("\n")
        return textwrap.indent(f"\n$$\n{lines}\n$$\n", match[1]) + "\n"

    def box(match: re.Match[str]) -> str:
        first, _, rest = match[2].partition("\n")
        body = textwrap.indent(f"{first}\n{textwrap.dedent(rest)}", "    ").rstrip()
        return f'\n!!! {BOXES[match[1]]} "{match[1]}"\n\n{body}\n'

    text = BLOCK.sub(block, f"{text}\n")
    text = INLINE.sub(lambda match: f"${' '.join(match[1].split())}$", text)
    return BOX.sub(box, linked(text)).rstrip()


class Mathematics(Extension):
    """Rewrites every docstring that is loaded."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Griffe calls this with each module, class, function and attribute."""
        if obj.docstring is not None:
            text = markdown(obj.docstring.value)
            obj.docstring.value = fields(text) if obj.is_class else text

"""Mathematics of the site: LaTeX becomes MathML while the pages are built, so that no page asks
for a script or a font from elsewhere."""

import html
import re
from functools import cache
from typing import Any

from latex2mathml.converter import convert
from markdown import Extension, Markdown
from markdown.postprocessors import Postprocessor

WRITTEN = re.compile(r'<(span|div) class="arithmatex">\s*\\[(\[](.*?)\\[)\]]\s*</\1>', re.DOTALL)
"""What `pymdownx.arithmatex` makes of LaTeX between dollars."""
UNKNOWN = re.compile(r"<m[a-z]+>(?:\\[A-Za-z]*|&)</m[a-z]+>")

LONG = 50
"""Characters of LaTeX in a line of text that a telephone may not have the width for."""


@cache
def mathml(latex: str, display: str) -> str:
    """LaTeX as MathML; what the converter does not know is an error, lest it be shown as text."""
    latex = latex.strip().replace(r"\arg", r"\operatorname{arg}")
    if display == "block" and (r"\\" in latex or "&" in latex):
        # A bracket that follows `\begin` at once would be read as its option.
        first = "{[}" if latex.startswith("[") else latex[0]
        latex = rf"\begin{{align*}}{first}{latex[1:]}\end{{align*}}"
    found = convert(latex, display=display)
    left = UNKNOWN.search(found)
    if left is not None:
        raise ValueError(f"no MathML for {left.group()} in {latex}")
    # Browsers scroll a box that is too wide for the page, and no equation.
    if display == "block":
        return f'<div class="equation">{found}</div>'
    return f'<span class="wide">{found}</span>' if len(latex) > LONG else found


class MathMl(Postprocessor):
    """Replaces LaTeX in a page that is otherwise ready."""

    def run(self, text: str) -> str:
        """The page with MathML."""

        def rendered(match: re.Match[str]) -> str:
            display = "block" if match[1] == "div" else "inline"
            return mathml(html.unescape(match[2]), display)

        return WRITTEN.sub(rendered, text)


class Mathematics(Extension):
    """Comes after `pymdownx.arithmatex` with `generic`."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Python-Markdown calls this once."""
        md.postprocessors.register(MathMl(md), "mathml", -10)


def makeExtension(**settings: Any) -> Mathematics:
    """Python-Markdown calls this by name."""
    return Mathematics(**settings)

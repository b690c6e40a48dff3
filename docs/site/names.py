"""Where the names of the package are explained on the site, and links that lead there."""

import re
from pathlib import Path

DOCUMENTED = re.compile(r"^::: ewif_jax\.([\w.]+)$", re.MULTILINE)
FENCE_LINK_HEADING_OR_CODE = re.compile(
    r"(^(?P<fence>`{3,}).*?^(?P=fence)$|^#.*?$|\[[^\]\n]*\][(\[]|``[^\n]*?``)"
    r"|`((?:ej\.)?([A-Za-z_][\w.]*)(?:\([^`]*\))?)`",
    re.DOTALL | re.MULTILINE,
)
ORDINARY = {"inputs", "step"}
"""Names that are also words for other things: an argument, a step of time."""

FOLDER = Path(__file__).parents[1] / "api"
DOCUMENTED_NAMES = {
    name for page in FOLDER.glob("*.md") for name in DOCUMENTED.findall(page.read_text())
} - ORDINARY


def linked(markdown: str) -> str:
    """A page in which `name` leads to what it names, if that is a public name."""

    def link(match: re.Match[str]) -> str:
        if match[4] not in DOCUMENTED_NAMES:
            return match[0]
        return f"[`{match[3]}`][ewif_jax.{match[4]}]"

    return FENCE_LINK_HEADING_OR_CODE.sub(link, markdown)

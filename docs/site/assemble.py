"""Lays the pages of the site out in build/pages: those of `docs/`, and those made of other files.

In the repository a page links to files by their place in it. On the site the same link leads to the
page made of that file: a Markdown file is one, a notebook becomes one with its figures, and a file
of source that some page links to is shown as it is.
"""

import base64
import json
import posixpath
import re
import shutil
from pathlib import Path

from names import linked

ROOT = Path(__file__).parents[2]
OUT = ROOT / "build" / "pages"
ELSEWHERE = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "benchmarks/README.md": "benchmarks.md",
    "ewif_jax/fast/README.md": "fast.md",
    "notebooks/README.md": "notebooks/index.md",
}
"""Pages that do not lie in `docs/`: where they are on the site."""
LANGUAGES = {".py": "python", ".toml": "toml", ".cff": "yaml"}
LINK = re.compile(r"(\]\()(?!https?:|mailto:|#)([^)\s#]+)((?:#[^)]*)?\))")


def in_docs() -> dict[str, str]:
    """Where on the site each file of `docs/` is, by its place in the repository."""
    files = (path for path in (ROOT / "docs").rglob("*") if path.is_file())
    shown = (path for path in files if path.suffix not in (".py", ".pyc"))
    return {
        path.relative_to(ROOT).as_posix(): path.relative_to(ROOT / "docs").as_posix()
        for path in shown
    }


def notebook_page(notebook: Path) -> str:
    """A notebook as a page; its figures are written beside it."""
    parts = []
    for number, cell in enumerate(json.loads(notebook.read_text())["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for place, output in enumerate(cell["outputs"]):
            image = output.get("data", {}).get("image/png")
            if image is not None:
                figure = f"{notebook.stem}-{number}-{place}.png"
                (OUT / "notebooks" / figure).write_bytes(base64.b64decode("".join(image)))
                parts.append(f"![What the cell above draws]({figure})")
            elif "text" in output:
                text = "".join(output["text"]).rstrip()
                parts.append(f"```{{.text .output}}\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def source_page(path: str) -> str:
    """A file of source as a page, which the search leaves out."""
    source = ROOT / path
    return (
        f"---\nsearch:\n  exclude: true\n---\n\n# {path}\n\n"
        f"````{LANGUAGES[source.suffix]}\n{source.read_text()}````\n"
    )


def moved(markdown: str, path: str, places: dict[str, str], sources: set[str]) -> str:
    """The page of `path` with links as they are on the site; what it adds to `sources` is shown."""

    def link(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(path), match[2]))
        place = places.get(target)
        if place is None and posixpath.splitext(target)[1] in LANGUAGES:
            sources.add(target)
            place = f"source/{target}.md"
        if place is None:
            return match[0]
        return match[1] + posixpath.relpath(place, posixpath.dirname(places[path])) + match[3]

    return LINK.sub(link, markdown)


def main() -> None:
    """Writes build/pages anew."""
    shutil.rmtree(OUT, ignore_errors=True)
    notebooks = {
        f"notebooks/{path.name}": f"notebooks/{path.stem}.md"
        for path in sorted((ROOT / "notebooks").glob("*.ipynb"))
    }
    places = in_docs() | ELSEWHERE | notebooks
    sources: set[str] = set()
    (OUT / "notebooks").mkdir(parents=True)
    for path, place in places.items():
        target = OUT / place
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.suffix != ".md":
            shutil.copy(ROOT / path, target)
            continue
        page = notebook_page(ROOT / path) if path in notebooks else (ROOT / path).read_text()
        target.write_text(linked(moved(page, path, places, sources)))
    for path in sources:
        target = OUT / "source" / f"{path}.md"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(source_page(path))


if __name__ == "__main__":
    main()

"""Builds the site into build/site; anything that the tools complain of is an error, and so is a
page that asks another server for a script, a style or a font, or shows unfinished mathematics.

Run from the top folder: `python docs/site/build.py`.
"""

import re
import subprocess
import sys
from pathlib import Path

import assemble

SITE = assemble.ROOT / "build" / "site"
COMPLAINT = re.compile(
    r"^(?:\w*griffe\w*|mkdocstrings\w*|autorefs|WARNING|Warning)\b.*", re.MULTILINE
)
WRONG = re.compile(
    r'<script[^>]+src="https?:[^"]*|<link[^>]+rel="(?:stylesheet|preconnect)"[^>]+href="https?:[^"]*'
    r'|<img[^>]+src="https?:[^"]*|class="arithmatex"|:math:`|<autoref[^>]*'
)
CODE = re.compile(r"<pre.*?</pre>", re.DOTALL)


def main() -> int:
    """Whether it failed."""
    assemble.main()
    command = [sys.executable, "-m", "zensical", "build", "-f", "mkdocs.yml", "--strict", "--clean"]
    done = subprocess.run(
        command, cwd=assemble.ROOT, check=False, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    print(done.stdout)
    wrong = [f"{found} (said while building)" for found in COMPLAINT.findall(done.stdout)]
    for page in sorted(SITE.rglob("*.html")):
        where = page.relative_to(SITE)
        wrong += [f"{found} in {where}" for found in WRONG.findall(CODE.sub("", page.read_text()))]
    print(*wrong, f"{len(list(SITE.rglob('*.html')))} pages in {where_from_here(SITE)}", sep="\n")
    return done.returncode or bool(wrong)


def where_from_here(path: Path) -> Path:
    """A path as it is typed here."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


if __name__ == "__main__":
    sys.exit(main())

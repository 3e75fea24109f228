"""Gather the pages of the site in a folder: python scripts/site_pages.py build/pages.

Pages and their pictures keep the paths that they have in the repository, so the links between them
need no change. The reference is written from docstrings by mkdocstrings.
"""

from __future__ import annotations

import posixpath
import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "suites/nico/README.md")
REFERENCE = {
    "policy": ["policy"],
    "transforms": [
        "transforms.frame_encoder",
        "transforms.demonstration_source",
        "transforms.lookup",
        "transforms.behavior_matching",
    ],
    "gwr": ["modules.gwr", "modules.gwr_estimator", "modules.behavior_groups"],
    "encoders": [
        "modules.frame_network",
        "modules.vae",
        "modules.sequence_autoencoder",
        "modules.inverse_model",
        "encoders.pretrained",
        "encoders.representation",
    ],
    "objectives": [
        "objectives.ddpg",
        "objectives.maml",
        "objectives.supervised",
    ],
    "algorithms": ["algorithms.algorithm", "algorithms.observation", "algorithms.bgpo"],
    "training": ["training", "configs.runs", "configs.algorithms"],
    "scenes": ["scenes.scene", "scenes.simulation"],
    "data": ["data.recording", "data.dataset", "data.bank"],
}
TITLES = {
    "policy": "Trained policies",
    "gwr": "GWR-B and groups of behaviors",
    "objectives": "Losses",
    "data": "Demonstrations",
}
PICTURE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")
PAGE_NAME = re.compile(r"`([\w/]+\.md)`")


def gather(out: Path) -> None:
    """Write the pages of the site to a folder, in place of what it held."""
    shutil.rmtree(out, ignore_errors=True)
    pages = [*PAGES, *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]
    for page in pages:
        text, folder = (ROOT / page).read_text(), posixpath.dirname(page)
        for picture in PICTURE.findall(text):
            path = posixpath.normpath(posixpath.join(folder, picture))
            (out / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / path, out / path)
        _write(out / page, _link_pages(text, page, pages))
    for name, modules in REFERENCE.items():
        sections = [f"## `bgpo_trl.{module}`\n\n::: bgpo_trl.{module}\n" for module in modules]
        title = TITLES.get(name, name.capitalize())
        _write(out / "reference" / f"{name}.md", "\n".join([f"# {title}\n", *sections]))


def _link_pages(text: str, page: str, pages: list[str]) -> str:
    """Make links of the names of other pages."""

    def link(match: re.Match[str]) -> str:
        if match[1] not in pages or match[1] == page:
            return match[0]
        return f"[{match[0]}]({posixpath.relpath(match[1], posixpath.dirname(page) or '.')})"

    return PAGE_NAME.sub(link, text)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


if __name__ == "__main__":
    gather(Path(sys.argv[1]))

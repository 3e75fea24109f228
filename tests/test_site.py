"""The documentation as a site: it is built without warnings, and no link in it is dead."""

import runpy
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

ROOT = Path(__file__).parents[1]
BUILD = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]


class Links(HTMLParser):
    """Targets and anchors of an HTML page."""

    def __init__(self, page):
        super().__init__()
        self.targets, self.anchors = set(), {""}
        self.feed(page.read_text())

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.targets.add(value)
            elif name == "id":
                self.anchors.add(value)


def test_the_site_is_built_and_no_link_in_it_is_dead(tmp_path):
    gather = runpy.run_path(str(ROOT / "scripts" / "site_pages.py"))["gather"]
    gather(tmp_path / "build" / "pages")
    shutil.copyfile(ROOT / "zensical.toml", tmp_path / "zensical.toml")
    for package in ("bgpo_trl", "suites"):
        (tmp_path / package).symlink_to(ROOT / package)  # for the reference
    built = subprocess.run(BUILD, cwd=tmp_path, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr

    site = tmp_path / "build" / "site"
    pages = {page: Links(page) for page in site.rglob("*.html") if page.name != "404.html"}
    dead, inner = [], 0
    for page, links in pages.items():
        for target in links.targets:
            path, anchor = urldefrag(unquote(target))
            if ":" in path:
                continue  # elsewhere, or data
            file = page if not path else (page.parent / path).resolve()
            file = file / "index.html" if file.is_dir() else file
            known = pages[file].anchors if file in pages else {"", anchor}
            inner += 1
            if not file.exists() or anchor not in known:
                dead.append((page.name, target))
    assert dead == []
    assert inner > 500

"""The report as one self-contained HTML file."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from bgpo_trl.files.writing import write_whole


@dataclass(frozen=True)
class Section:
    """Section of the report: title, notes, figures and a table."""

    title: str
    table: list[list[str]] = field(default_factory=list)
    """Rows of cells, the first with the column names; omitted if empty."""
    figures: dict[str, Path] = field(default_factory=dict)
    """Paths by caption."""
    notes: list[str] = field(default_factory=list)


_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 64rem; margin: 2rem auto; padding: 0 1rem;
       color: #222; }
img { max-width: 100%; }
table { border-collapse: collapse; margin: 1rem 0; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; }
pre { background: #f6f6f6; padding: .6rem; overflow-x: auto; font-size: 12px; }
.note { color: #a33; }
.caption { color: #555; font-size: 13px; margin-top: -.6rem; }
"""


def write_page(
    path: Path,
    sections: Sequence[Section],
    runs: Mapping[str, tuple[Path, dict[str, Any], dict[str, Any]]],
) -> None:
    """Write the page, given directory, settings and summary of each run by name."""
    parts = ["<h1>bgpo_trl: report</h1>"]
    for section in sections:
        parts.append(f"<h2>{escape(section.title)}</h2>")
        parts += [f'<p class="note">{escape(note)}</p>' for note in section.notes]
        for caption, figure in section.figures.items():
            parts += [_image(figure, section.title), f'<p class="caption">{escape(caption)}</p>']
        parts += [_table(section.table)] if section.table else []
    parts.append("<h2>Test episodes after training, and settings</h2>")
    for name, (directory, config, summary) in runs.items():
        parts.append(f"<h3>{escape(name)}</h3>")
        frames = directory / "figures" / "episodes.png"
        if frames.exists():
            parts.append(_image(frames, f"frames of test episodes of {name}"))
        if summary.keys() >= {"commit", "command"}:
            parts.append(
                f"<p>Commit {escape(str(summary.get('commit')))}: "
                f"<code>{escape(str(summary.get('command')))}</code></p>"
            )
        settings = escape(json.dumps(config, indent=2))
        parts.append(f"<details><summary>settings</summary><pre>{settings}</pre></details>")
    body = "\n".join(parts)
    write_whole(
        path,
        "<!doctype html>\n<html lang='en'>\n<head><meta charset='utf-8'>"
        f"<title>bgpo_trl report</title><style>{_STYLE}</style></head>\n<body>\n{body}\n</body>\n"
        "</html>\n",
    )


def _image(path: Path, alt: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<p><img alt="{escape(alt)}" src="data:image/png;base64,{data}"></p>'


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *body = rows
    lines = ["<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>"]
    lines += [
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in body
    ]
    return "<table>" + "".join(lines) + "</table>"

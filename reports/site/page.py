"""The page of a site: one HTML file whose policy lets nothing run but its own script, and nothing leave."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from importlib.resources import files
from typing import Any

from ihbench.document.html import escape

SCRIPTS = ("dom", "leaderboard", "frames", "curves", "splats", "avatar", "about", "live", "app")  # in this order


@cache
def asset(name: str) -> str:
    """The text of a file beside this module."""
    return files("ihbench.reports.site").joinpath("assets", name).read_text(encoding="utf-8")


@cache
def script() -> str:
    """All of the page's JavaScript as one text."""
    parts = "\n".join(f"// ---- {name}.js\n{asset(f'{name}.js')}" for name in SCRIPTS)
    head = '"use strict";\n(() => {\nconst DATA = JSON.parse(document.getElementById("data").textContent);\n'
    return f"{head}{parts}}})();\n"


def policy(live: bool = False) -> str:
    """The content security policy: the page's own script and style by their hashes, pictures beside or in the page,
    nothing else. `live`: served by `ihbench view`, whose page asks its own server what has changed."""
    script_hash, style_hash = (_hash(text) for text in (script(), asset("page.css")))
    rules = {
        "default-src": "'none'",
        "script-src": f"'sha256-{script_hash}'",
        "style-src": f"'sha256-{style_hash}'",
        "img-src": "'self' data: blob:",
        "connect-src": "'self'" if live else "'none'",
        "base-uri": "'none'",
        "form-action": "'none'",
        "require-trusted-types-for": "'script'",
        "trusted-types": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def page(title: str, data: Mapping[str, Any], inside: Mapping[str, bytes], live: bool = False) -> str:
    """The whole page. `data` is strict JSON; `inside` are files that the page carries in itself, by name; `live` as
    `policy` has it."""
    carried = "\n".join(
        f'<script type="text/plain" id="file-{escape(name)}">{b64encode(content).decode("ascii")}</script>'
        for name, content in inside.items()
    )
    parts = {
        "policy": escape(policy(live)).replace("&#x27;", "'"),
        "title": escape(title),
        "style": asset("page.css"),
        "data": as_json(data),
        "files": carried,
        "script": script(),
    }
    text = asset("page.html")
    pieces = text.split("{{")
    return pieces[0] + "".join(parts[name] + rest for name, _, rest in (p.partition("}}") for p in pieces[1:]))


def as_json(data: Mapping[str, Any]) -> str:
    """JSON that may stand in a script element: no `<`, and nothing that ends a line of JavaScript."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    return b64encode(sha256(text.encode()).digest()).decode("ascii")


@dataclass(frozen=True)
class Site:
    """A site before it is written."""

    title: str
    data: Mapping[str, Any]
    files: Mapping[str, bytes] = field(default_factory=dict)  # pictures by name
    carried: Mapping[str, bytes] = field(default_factory=dict)  # what a page must have inside: it may not read files

    def html(self, single: bool = False, live: Mapping[str, Any] | None = None) -> str:
        """The page; `single` with everything inside, `live` with what a served page must know of its server."""
        inside = {**self.carried, **(self.files if single else {})}
        return page(self.title, {**self.data, "live": live}, inside, live is not None)

"""A site's page taken apart by a reader of its own."""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

import numpy as np

from ihbench.files.atomic import decode


@dataclass
class Page(HTMLParser):
    """Elements, and what stands in scripts and styles."""

    text: str
    tags: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    inside: dict[str, str] = field(default_factory=dict)  # id, or "script" and "style" of the page itself -> content

    def __post_init__(self):
        super().__init__()
        self._open: str | None = None
        self.feed(self.text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.tags.append((tag, given))
        if tag in ("script", "style"):
            self._open = given.get("id") or tag
            self.inside[self._open] = ""

    def handle_data(self, data):
        if self._open:
            self.inside[self._open] += data

    def handle_endtag(self, tag):
        if tag in ("script", "style"):
            self._open = None

    @property
    def data(self) -> dict[str, Any]:
        return json.loads(self.inside["data"])

    @property
    def policy(self) -> dict[str, str]:
        (rules,) = (a["content"] for tag, a in self.tags if a.get("http-equiv") == "Content-Security-Policy")
        return dict(rule.strip().partition(" ")[::2] for rule in (rules or "").split(";"))

    def file(self, name: str) -> bytes:
        return base64.b64decode(self.inside[f"file-{name}"])


def sha256(text: str) -> str:
    return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() + "'"


def value(score: Any, reasons: list[str]) -> Any:
    """A score as scores.jsonl has it, or the reason of its absence."""
    return reasons[score[0]] if isinstance(score, list) else decode(score)


def unpacked(own: bytes, skin: bytes, about: dict[str, Any]) -> dict[str, np.ndarray]:
    """What a page makes of an avatar's two files."""
    n = about["count"]
    own, skin = (np.frombuffer(zlib.decompress(data, -15), np.uint8) for data in (own, skin))
    assert (len(own), len(skin)) == (12 * n, 8 * n)

    def wide(at):
        steps = own[at : at + n].astype(np.uint16) + 256 * own[at + n : at + 2 * n].astype(np.uint16)
        return np.cumsum(steps, dtype=np.uint16) / 65535

    def narrow(data, at):
        return np.cumsum(data[at : at + n], dtype=np.uint8)

    low, high = np.log(about["scales"])
    return {
        "rest": np.stack([about["low"][k] + wide(2 * n * k) * about["size"][k] for k in range(3)], 1),
        "scales": np.exp(low + wide(6 * n) * (high - low)),
        "colours": np.stack([narrow(own, (8 + k) * n) for k in range(3)], 1),
        "labels": narrow(own, 11 * n),
        "bones": np.stack([narrow(skin, k * n) for k in range(4)], 1),
        "weights": np.stack([narrow(skin, k * n) for k in range(4, 8)], 1),
    }

"""A site's page taken apart by a reader of its own."""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from dataclasses import dataclass, field, replace
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
    above = (about["degree"] + 1) ** 2 - 1
    assert (len(own), len(skin)) == ((23 if about["general"] else 12) * n + 3 * above * n, 8 * n)
    at = 0

    def wides(count):
        nonlocal at
        planes = []
        for _ in range(count):
            low, high = own[at : at + n].astype(np.uint16), own[at + n : at + 2 * n].astype(np.uint16)
            planes.append(np.cumsum(low + 256 * high, dtype=np.uint16) / 65535)
            at += 2 * n
        return np.stack(planes, 1)

    def narrows(count):
        nonlocal at
        at += count * n
        return np.stack([np.cumsum(own[at - (count - k) * n :][:n], dtype=np.uint8) for k in range(count)], 1)

    low, high = np.log(about["scales"])
    found = {"rest": np.array(about["low"]) + wides(3) * about["size"]}
    if about["general"]:
        found |= {"scales": np.exp(low + wides(3) * (high - low)), "turns": 2 * wides(3) - 1}
        found["opacities"] = narrows(1)[:, 0]
    else:
        found["scales"] = np.exp(low + wides(1)[:, 0] * (high - low))
    found |= {"colours": narrows(3), "labels": narrows(1)[:, 0]}
    if above:
        found["harmonics"] = narrows(3 * above).reshape(n, above, 3)
    planes = np.cumsum(skin.reshape(8, n), 1, dtype=np.uint8)
    return found | {"bones": planes[:4].T, "weights": planes[4:].T}


@dataclass
class Plates:
    """An avatar of flat, half transparent Gaussians on the body, of any colours, from every side others up to
    `degree`. It says what skins it where it is `told`, turns its elbows by itself where it is `learned`,
    and its colours with them where they are `turning`."""

    body: Any
    betas: np.ndarray
    count: int = 900
    degree: int | None = None
    told: bool = False
    learned: bool = False
    turning: bool = False

    def __post_init__(self):
        from ihbench.body.uv import texel_table

        rng = np.random.default_rng(0)
        texels = texel_table(self.body, 64)
        some = np.sort(rng.choice(len(texels.face), self.count, replace=False))
        self.rest = texels.interpolate(self.body.shaped(self.betas)[0], self.body.faces)[some]
        self.weights_ = texels.interpolate(self.body.weights, self.body.faces)[some]
        self.factors = rng.normal(size=(self.count, 3, 3)) * (0.03, 0.01, 0.002)
        self.opacities, self.colours = rng.uniform(0.2, 1, self.count), rng.uniform(0, 1, (self.count, 3))
        if self.degree is not None:
            self.colours = rng.normal(size=(self.count, (self.degree + 1) ** 2, 3)) * 0.2

    def posed_gaussians(self, pose):
        import torch

        from ihbench.fit.gaussians.posed import PosedGaussians

        pose = self.as_learned(pose) if self.learned else pose
        blend = np.tensordot(self.weights_, self.body.joint_transforms(pose)[:, :3], 1)
        factors = blend[:, :, :3] @ self.factors
        means = np.einsum("nab,nb->na", blend[:, :, :3], self.rest) + blend[:, :, 3]
        colours = self.turned(blend[:, :, :3]) if self.turning else self.colours
        parts = (means, factors @ factors.transpose(0, 2, 1), colours, self.opacities, self.weights_)
        means, covariances, colours, opacities, weights = (torch.from_numpy(p.astype(np.float32)) for p in parts)
        told = weights if self.told else None
        return PosedGaussians(means, covariances, colours, None, opacities, self.degree, told)

    def turned(self, linear):
        """The harmonics in the world of colours that are seen from directions at rest."""
        import torch

        from ihbench.render.spherical_harmonics import basis

        world = np.random.default_rng(1).normal(size=(80, 3))
        world /= np.linalg.norm(world, axis=1, keepdims=True)
        rest = np.einsum("nba,db->nda", linear, world)
        rest /= np.linalg.norm(rest, axis=2, keepdims=True)
        seen = basis(torch.from_numpy(rest.reshape(-1, 3)), 3).numpy().reshape(*rest.shape[:2], -1) @ self.colours
        return np.linalg.pinv(basis(torch.from_numpy(world), 3).numpy()) @ seen

    @staticmethod
    def as_learned(pose):
        """More the further the back is bent."""
        angles = np.array(pose.pose)
        angles[[18, 19], 1] += 1.5 * np.sin(angles[3, 0])
        return replace(pose, pose=angles)

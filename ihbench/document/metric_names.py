"""What tells metrics apart that are called alike: two definitions of PSNR in one region are two numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from ihbench.metrics.identity import Identity


def variants_told(identities: Iterable[Identity]) -> dict[Identity, str]:
    """Identity -> "(occnerf-pooled)", to be said beside its metric and region, where another of these has the same
    two; "" where none has. In the order given. Where the variant is the same as well, everything else is said."""
    told = dict.fromkeys(identities, "")
    names = Counter((i.metric, i.region) for i in told)
    variants = Counter((i.metric, i.region, i.variant) for i in told)
    for i in told:
        if names[i.metric, i.region] > 1:
            told[i] = f"({i.variant if variants[i.metric, i.region, i.variant] == 1 else _definition(i)})"
    return told


def named(identities: Iterable[Identity]) -> dict[Identity, str]:
    """Identity -> the title of its metric, with the variant where it is told: "PSNR (occnerf-pooled)"."""
    return {i: f"{i.display.title} {said}".rstrip() for i, said in variants_told(identities).items()}


def heads(identities: Iterable[Identity], region: bool = False) -> dict[Identity, str]:
    """Identity -> the head of its column: "PSNR ↑", with the region "PSNR hidden ↑"; with the variant as `named`."""
    told = variants_told(identities)
    return {i: i.display.head(f"{i.region if region else ''} {said}".strip()) for i, said in told.items()}


def _definition(identity: Identity) -> str:
    parts = (identity.variant, identity.value_range, identity.background, f"v{identity.version}")
    return "/".join(part for part in parts if part)

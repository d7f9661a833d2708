"""Run records of earlier schema versions, brought to the next one. What is damaged in them stays damaged: the check
comes afterwards."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Json = Mapping[str, Any]


def _to_2(old: Json) -> Json:
    """Schema 2: the outcome in one place, switches as values, no table of the ledger, which can be computed."""
    record = {name: value for name, value in old.items() if name not in ("status", "reason", "created", "updated")}
    record["outcome"] = {name: old[name] for name in ("status", "reason", "created", "updated") if name in old}
    record |= {name: {} for name in ("machine", "provenance") if old.get(name) is None}
    if isinstance(about := old.get("about"), dict):
        record["about"] = {name: value for name, value in about.items() if name != "provenance"}
        if about.get("provenance") == "predictions":
            record["about"].setdefault("predictions", {"missing": [], "surplus": [], "notes": []})
        if isinstance(changed := about.get("changed"), list) and all(isinstance(text, str) for text in changed):
            record["about"]["changed"] = {
                name: _value(old.get("identity"), name, text) for name, _, text in (c.partition("=") for c in changed)
            }
    if isinstance(ledger := old.get("ledger"), dict):
        record["ledger"] = {name: value for name, value in ledger.items() if name != "table"}
    return record


def _value(identity: Any, name: str, text: str) -> Any:
    """A switch's value from the configuration; its text where that does not have it."""
    if name == "keep":
        return text.split(",")
    value = identity.get("config") if isinstance(identity, dict) else None
    for part in name.split("."):
        value = value.get(part, text) if isinstance(value, dict) else text
    return value


# schema version -> what brings a record of that version to the next one
MIGRATIONS: dict[int, Callable[[Json], Json]] = {1: _to_2}

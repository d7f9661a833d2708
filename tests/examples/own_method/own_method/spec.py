"""What ihbench knows of the method before it imports it: its name, its switches, where its class is."""

from dataclasses import dataclass

from ihbench.scene.method_spec import MethodSpec


@dataclass(frozen=True)
class MannequinConfig:
    brightness: float = 0.5
    """The mesh's grey, 0 to 1."""
    seed_step: float = 0.01
    """How much brighter it gets with every seed."""


SPEC = MethodSpec(
    name="mannequin",
    title="Mannequin",
    summary="the body mesh in one grey: nothing is learned",
    method="own_method.method:Mannequin",
    profiles={"quick": MannequinConfig(), "paper": MannequinConfig()},
)

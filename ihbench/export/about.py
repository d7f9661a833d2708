"""What an exported file says of itself, and what may be done with it."""

from __future__ import annotations

from ihbench.body import Body
from ihbench.record.schema import RunRecord
from ihbench.version import __version__

GENERATOR = f"ihbench {__version__}"
SMPL_LICENCE = (
    "Holds parts of the SMPL body model (template, shape, skinning weights or joints), whose licence does not allow "
    "passing them on: not for redistribution. See https://smpl.is.tue.mpg.de/modellicense.html"
)
SHAPED = "Made on a body of SMPL's shape space; holds no part of the SMPL body model."
OWN_BODY = "Holds a body that is not SMPL's: ihbench's procedural one (Apache-2.0), or your own."


def licence(body: Body, holds_body: bool) -> str:
    """Of a file of an avatar on this body, which holds the body's mesh or weights, or not."""
    if body.name == "smpl":
        return SMPL_LICENCE if holds_body else SHAPED
    return OWN_BODY if holds_body else ""


def data_note(record: RunRecord) -> str:
    """Whose likeness it is."""
    standin = record.about.standin
    if standin:
        return f"{standin}: a person made by the bench"
    return f"a person of {record.identity.dataset}: that data set's licence holds for pictures and models of them"


def facts(record: RunRecord) -> dict[str, str]:
    """What names the run."""
    who = record.identity
    return {"run": record.digest, "method": who.method, "protocol": who.protocol, "scene": who.scene}

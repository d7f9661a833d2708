"""A protocol of your own: another occlusion, fewer frames, a name and a version of its own.

    python 03_own_protocol.py

What it changes makes another digest, so that its numbers are never in one table with those of the one it came from.
"""

from pathlib import Path

import ihbench
from ihbench import registry
from ihbench.scene.protocol import load_protocol

source = registry.package_folder("protocol", "zju_occ") / "zju_occ.toml"
text = source.read_text(encoding="utf-8")
for old, new in (
    ('id = "zju_occ"', 'id = "half_hidden"'),
    ('rule = "fixed-strip" ', 'rule = "lower-half" '),
    ('unlisted = "strip-generic"', 'unlisted = "lower-half"'),
    ("frames = { start = 0, stop = 500, step = 5 }", "frames = { start = 0, stop = 500, step = 100 }"),
    ("[profile.quick]", "[profile.quick]\ntrain = { frames = { step = 100 } }"),
    ("cameras = { step = 2 }, frames = { step = 120 }", "cameras = { step = 8 }, frames = { step = 480 }"),
):
    assert old in text, old
    text = text.replace(old, new, 1)
mine = Path("half_hidden.toml")
mine.write_text(text, encoding="utf-8")

for protocol in ("zju_occ", str(mine)):
    known = load_protocol(protocol, "quick")
    print(f"{known.name:16} digest {known.digest}, occlusion {known.occlusion.unlisted}")

scene, _ = ihbench.load_scene(str(mine), "standin-1", image_size=64)
print(f"{len(scene.train)} training views; hidden of the person: {scene.hiding.hidden_share():.0%}")
print(f"ihbench run --protocol {mine} --scene standin-1    # fits and scores under it")

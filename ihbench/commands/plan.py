"""`ihbench plan`: what a run would do, what is left out and why. Runs nothing, imports neither torch nor cv2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ihbench.commands.options.parse import options
from ihbench.commands.options.printing import Printing
from ihbench.commands.options.scene_choice import SceneChoice
from ihbench.document.document import Block, Heading, Paragraph, bullets
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.scene.plan import SceneMeasure
    from ihbench.scene.protocol import Protocol


def main(argv: list[str]) -> int:
    chosen = options(PlanOptions, argv, "plan", "What a run would do, what is left out and why. Runs nothing.")
    from ihbench.scene.protocol import load_protocol

    protocols = chosen.apply(load_protocol(chosen.protocol, chosen.profile))
    reports = [_planned(chosen, protocol) for protocol in protocols]
    blocks = [block for report in reports for block in _blocks(report)]
    chosen.show(reports[0] if len(reports) == 1 else {"protocols": reports}, blocks)
    return 0


@dataclass(frozen=True, kw_only=True)
class PlanOptions(SceneChoice, Printing):
    """As `ihbench run` takes them."""


def _planned(chosen: SceneChoice, protocol: Protocol) -> dict[str, Any]:
    """Of a run under one protocol."""
    from ihbench.clock.machine import cpu_model
    from ihbench.record.finished_run import earlier_runs
    from ihbench.record.source_digest import code_of
    from ihbench.runner.run_loop import configuration
    from ihbench.scene.data_source import locate, open_capture
    from ihbench.scene.method_spec import method_spec
    from ihbench.scene.plan import absent_regions, measure_scene
    from ihbench.scene.views import open_scene

    config = configuration(chosen.method, chosen.profile, {})
    source = locate(protocol, chosen.data, chosen.scene)
    code = code_of(protocol, chosen.method)
    earlier = earlier_runs(chosen.runs, chosen.method, protocol.name, chosen.profile, cpu_model(), code)
    scenes: dict[str, dict[str, Any]] = {}
    for scene in source.scenes:
        if not source.exists(scene):
            scenes[scene] = {"note": "stand-in not made yet: the run makes it; measured then"}
            continue
        capture, _ = open_capture(protocol.dataset, source.root, scene, chosen.body)
        where = f"{capture.dataset} {capture.name}"
        protocol.check_views(capture.name, capture.n_frames, len(capture.camera_ids), where)
        try:
            measure = measure_scene(open_scene(capture, protocol))
        except BadInput as error:
            if not source.is_standin:
                raise
            scenes[scene] = {"note": f"the run makes the rest of this stand-in; measured then: {error}"}
            continue
        stages = {} if earlier is None else earlier.stages
        needless = method_spec(chosen.method).omissions(config, measure)
        left_out = [
            {name: getattr(o, name) for name in ("field", "value", "reason", "spares")}
            | {"seconds": o.seconds(stages)}
            for o in needless + absent_regions(measure, protocol.metrics.regions)
        ]
        scenes[scene] = {"measure": measure, "left_out": left_out}
    return {
        "protocol": protocol.name,
        "profile": chosen.profile,
        "method": chosen.method,
        "data": "stand-in" if source.is_standin else str(source.root),
        "expected_seconds_per_scene": None if earlier is None else earlier.seconds,
        "earlier_runs": 0 if earlier is None else earlier.count,
        "earlier_runs_had_other_switches": earlier is not None and not earlier.same_switches,
        "earlier_runs_had_other_code": earlier is not None and not earlier.same_code,
        "config": config,
        "scenes": scenes,
    }


def _blocks(plan: Mapping[str, Any]) -> list[Block]:
    expected = "unknown, no earlier run of this protocol on such a processor to go by"
    if plan["expected_seconds_per_scene"]:
        count = plan["earlier_runs"]
        others = " with other switches" * plan["earlier_runs_had_other_switches"]
        others += " by other code" * plan["earlier_runs_had_other_code"]
        which = f"{count} earlier run{'s' * (count > 1)} of this protocol on such a processor{others}"
        expected = f"{plan['expected_seconds_per_scene']:.0f} s per scene, the median of {which}"
    blocks: list[Block] = [
        Paragraph("{method} under {protocol}, {profile} profile, on {data}".format(**plan)),
        Paragraph(f"expected: {expected}"),
    ]
    for scene, found in plan["scenes"].items():
        lines = [found["note"]] if "note" in found else _lines(found["measure"], found["left_out"])
        blocks += [Heading(2, scene), *bullets(lines)]
    return blocks


def _lines(m: SceneMeasure, left_out: Sequence[Mapping[str, Any]]) -> list[str]:
    """What was measured of a scene, and what is left out."""
    lines = [
        f"{m.training_views} training views ({m.covered_views} occluded), {m.test_views} test views",
        f"occlusion {_rule(m.occlusion)}: hides {m.hidden_share:.0%} of the person in occluded views",
    ]
    if m.in_scene:
        lines.append(
            "the occluder stands in the scene: every frame is covered, what it hides in tests is in no region"
        )
    lines += [
        f"surface: {m.visible_texels:.0%} seen, {m.hidden_texels:.0%} only behind the occluder, "
        f"{m.never_seen_texels:.0%} never faced the camera",
        f"joints move up to {m.motion_deg:.0f}°, the person turns {m.turn_deg:.0f}°",
        f"a pixel of the protocol's image covers {m.pixel_mm:.1f} mm of the body",
    ]
    for o in left_out:
        saved = f" (saves about {o['seconds']:.0f} s)" if o["seconds"] is not None else ""
        lines.append(f"left out: {o['field']} -> {o['value']}: {o['reason']}{saved}")
    if any(o["value"] is not None for o in left_out):
        lines.append("`ihbench run --keep FIELD` keeps what the plan would change, `--keep all` everything")
    return lines if left_out else [*lines, "left out: nothing; this scene needs all of it"]


def _rule(occlusion: Mapping[str, str | float]) -> str:
    """A rule and what it was drawn with, as `strip-generic (mid 503, width 60)`."""
    drawn = ", ".join(f"{name} {value}" for name, value in occlusion.items() if name != "rule")
    return f"{occlusion['rule']} ({drawn})" if drawn else str(occlusion["rule"])

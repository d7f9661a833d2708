"""`ihbench plan`: what a run would do, what is left out and why. Runs nothing, imports neither torch nor cv2."""

from __future__ import annotations

from collections.abc import Mapping
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


@dataclass(frozen=True)
class LeftOut:
    """An `Omission`, and what it saves."""

    field: str
    value: Any
    reason: str
    spares: Mapping[str, float]
    seconds: float | None


@dataclass(frozen=True)
class ScenePlan:
    measure: SceneMeasure
    left_out: tuple[LeftOut, ...]


@dataclass(frozen=True)
class NotMeasured:
    note: str


@dataclass(frozen=True)
class Plan:
    """Of a run under one protocol."""

    protocol: str
    profile: str
    method: str
    data: str
    expected_seconds_per_scene: float | None
    earlier_runs: int
    earlier_runs_had_other_switches: bool
    earlier_runs_had_other_code: bool
    config: Any  # the method's
    scenes: Mapping[str, ScenePlan | NotMeasured]


def _planned(chosen: SceneChoice, protocol: Protocol) -> Plan:
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
    scenes: dict[str, ScenePlan | NotMeasured] = {}
    for scene in source.scenes:
        if not source.exists(scene):
            scenes[scene] = NotMeasured("stand-in not made yet: the run makes it; measured then")
            continue
        capture, _ = open_capture(protocol.dataset, source.root, scene, chosen.body)
        where = f"{capture.dataset} {capture.name}"
        protocol.check_views(capture.name, capture.n_frames, len(capture.camera_ids), where)
        try:
            measure = measure_scene(open_scene(capture, protocol))
        except BadInput as error:
            if not source.is_standin:
                raise
            scenes[scene] = NotMeasured(f"the run makes the rest of this stand-in; measured then: {error}")
            continue
        stages = {} if earlier is None else earlier.stages
        needless = method_spec(chosen.method).omissions(config, measure)
        omissions = needless + absent_regions(measure, protocol.metrics.regions)
        left_out = tuple(LeftOut(o.field, o.value, o.reason, o.spares, o.seconds(stages)) for o in omissions)
        scenes[scene] = ScenePlan(measure, left_out)
    data = "stand-in" if source.is_standin else str(source.root)
    before = (None, 0, False, False)
    if earlier is not None:
        before = earlier.seconds, earlier.count, not earlier.same_switches, not earlier.same_code
    return Plan(protocol.name, chosen.profile, chosen.method, data, *before, config, scenes)


def _blocks(plan: Plan) -> list[Block]:
    on = f"{plan.method} under {plan.protocol}, {plan.profile} profile, on {plan.data}"
    seconds = plan.expected_seconds_per_scene
    expected = "unknown, no earlier run of this protocol on such a processor to go by"
    if seconds:
        which = f"{plan.earlier_runs} earlier run{'s' * (plan.earlier_runs > 1)} of this protocol"
        others = " with other switches" if plan.earlier_runs_had_other_switches else ""
        others += " by other code" if plan.earlier_runs_had_other_code else ""
        expected = f"{seconds:.0f} s per scene, the median of {which} on such a processor{others}"
    blocks: list[Block] = [Paragraph(on), Paragraph(f"expected: {expected}")]
    for scene, found in plan.scenes.items():
        blocks += [Heading(2, scene), *bullets([found.note] if isinstance(found, NotMeasured) else _lines(found))]
    return blocks


def _lines(plan: ScenePlan) -> list[str]:
    """What was measured of a scene, and what is left out."""
    m = plan.measure
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
    for o in plan.left_out:
        saved = f" (saves about {o.seconds:.0f} s)" if o.seconds is not None else ""
        lines.append(f"left out: {o.field} -> {o.value}: {o.reason}{saved}")
    if any(o.value is not None for o in plan.left_out):
        lines.append("`ihbench run --keep FIELD` keeps what the plan would change, `--keep all` everything")
    return lines if plan.left_out else [*lines, "left out: nothing; this scene needs all of it"]


def _rule(occlusion: Mapping[str, str | float]) -> str:
    """A rule and what it was drawn with, as `strip-generic (mid 503, width 60)`."""
    drawn = ", ".join(f"{name} {value}" for name, value in occlusion.items() if name != "rule")
    return f"{occlusion['rule']} ({drawn})" if drawn else str(occlusion["rule"])
